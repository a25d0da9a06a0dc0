"""Fuzzing target: messages of clients to a server of sessions."""

from __future__ import annotations

import asyncio
import functools
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.interactive.server import wire
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.types import InputError
from tests.fuzz.mutations import json_value
from tests.fuzz.target import Target

SESSION, WATCH = "fuzzed", "watched"


@functools.cache
def _service() -> Any:
    """Service of a painted world with a session that no message names."""
    from egosim_jax.interactive.options import Limits
    from egosim_jax.interactive.server.service import Service
    from egosim_jax.interactive.server.store import Store
    from tests.painted import painted

    folder = Path(tempfile.mkdtemp())
    service = Service(Store(folder, painted(), Limits()), world="painted")
    watched = service.store.create({"session": WATCH, "seed": 3})
    rows = watched.actions.rest[None]
    service.store.step({"session": WATCH, "step_id": 1, "actions": rows}).result()
    return service


def _messages() -> dict[str, dict[str, Any]]:
    rows = np.tile([0.15, 0.02, 0.16, -0.5, 0.0, 0.4, 0.25], (4, 1))
    own = {"session": SESSION, "observe": ["frames", "depth", "keypoints", "state"]}
    return {
        "create": {"request": "create", "seed": 7, "actions": {"layout": "gripper"}, "prompt": "x"},
        "step": {"request": "step", "step_id": 1, "actions": rows, **own},
        "stream": {"request": "step", "step_id": 1, "actions": rows, "stream": True, **own},
        "json_step": {"request": "step", "step_id": 1, "actions": rows.tolist(), **own},
        "reset": {"request": "reset", "seed": 3, **own},
        "save": {"request": "save", "session": SESSION, "name": "a"},
        "load": {"request": "load", "session": SESSION, "name": "a"},
        "close": {"request": "close", "session": SESSION, "keep": False},
        "status": {"request": "status", "session": SESSION},
    }


def _files() -> dict[str, bytes]:
    """Messages as MessagePack, and as the JSON bodies of HTTP."""
    found = {}
    for name, message in _messages().items():
        found[f"{name}.bin"] = wire.pack(message)
        found[f"{name}.json"] = wire.pack_json(message)
    return found


def _make(folder: Path) -> None:
    for name, data in _files().items():
        (folder / name).write_bytes(data)


def _read(folder: Path) -> Any:
    """Send all messages; the session that they name is there again before each of them."""
    names = []
    for name, unchanged in _files().items():
        data = (folder / name).read_bytes()
        if data == unchanged and name != "status.bin":
            continue  # only what was changed, so that a case is one message
        names.append(_send(data, json=name.endswith(".json")))
    return names


def _send(data: bytes, *, json: bool) -> str:
    service = _service()
    store = service.store
    if SESSION not in store.sessions:
        store.create({"session": SESSION, "seed": 3})
    try:
        message = wire.unpack_json(data) if json else wire.unpack(data, limit=wire.MAX_BYTES)
        asyncio.run(_reply(service, message, json=json))
    except RequestError as error:
        if error.code == "internal":
            raise (error.__cause__ or error) from None
        raise InputError(str(error)) from None
    finally:
        watched = store.sessions[WATCH]
        assert watched.committed == 1
        assert not watched.busy
        for name in set(store.sessions) - {SESSION, WATCH}:
            store.remove({"session": name}).result()
    return "done"


async def _reply(service: Any, message: Any, *, json: bool) -> None:
    """Pack what a client gets: over HTTP one reply, over the websocket also frames before it."""
    if json:
        wire.pack_json(await service.handle(message))
        return
    async for reply in service.replies(message):
        wire.pack(reply)


TARGETS = [
    Target(
        name="message",
        make=_make,
        read=_read,
        files=("*.bin", "*.json"),
        lossy="a changed message may be another valid one",
        mutations=(json_value,),
    )
]
