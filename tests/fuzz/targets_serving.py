"""Fuzzing targets: messages of clients to a server of sessions, and the frames they come in."""

from __future__ import annotations

import asyncio
import functools
import json
import logging
import socket
import struct
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import msgpack
import numpy as np

from egosim_jax.interactive.server import wire
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.requests import REQUESTS
from egosim_jax.interactive.server.server import _from_json
from egosim_jax.types import InputError
from tests.fuzz.mutations import BYTES, json_value
from tests.fuzz.target import Target
from tests.fuzz.targets_expanding import ARCHIVE, make_episode

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
        "episode": {"request": "reset", "episode": _episode(), **own},
    }


@functools.cache
def _episode() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        make_episode(Path(folder))
        return (Path(folder) / "x.zip").read_bytes()


def _files() -> dict[str, bytes]:
    """Messages as MessagePack, and as the JSON bodies of HTTP."""
    found = {}
    for name, message in _messages().items():
        found[f"{name}.bin"] = wire.pack(message)
        found[f"{name}.json"] = _to_json(message)
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
        message = _from_json(wire.unpack_json(data)) if json else _unpack(data)
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


def _unpack(data: bytes) -> Any:
    return wire.unpack(data, limit=wire.MAX_BYTES)


async def _reply(service: Any, message: Any, *, json: bool) -> None:
    """Pack what a client gets: over HTTP one reply, over the websocket also frames before it."""
    if json:
        wire.pack_json(await service.handle(message))
        return
    async for reply in service.replies(message):
        wire.pack(reply)


def _to_json(message: dict[str, Any]) -> bytes:
    return json.dumps(wire.to_json(message), default=_as_text).encode()


def _as_text(value: Any) -> str:
    import base64

    return base64.b64encode(value).decode() if isinstance(value, bytes) else repr(value)


ROWS = np.tile([0.15, 0.02, 0.16, -0.5, 0.0, 0.4, 0.25], (4, 1))
ARRAY = {b"__ndarray__": True, b"data": bytes(8), b"dtype": "<f8", b"shape": [1]}
DEEP = functools.reduce(lambda inner, _: [inner], range(400), 0)
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 2, 10**6, 2**63 - 1, 2**64 - 1, 1e308, float("nan"), float("inf"), "",
    "x" * 100_000, "\x1b[31m", "../..", "frames", b"", b"PK", bytes(10**6), [], {}, [[]], DEEP,
    [None] * 9, ["depth"] * 1000, [[0.1] * 7, [0.1]], [0] * 250_000, {"layout": "wrist"},
    {"layout": "keypoints", "sides": ["left", "right"], "camera": True}, {"sides": [3]},
    {"workspace_m": [[float("nan")] * 3, [1e308] * 3]}, {"camera_reach": [1e308, 3]},
    ROWS * np.nan, ROWS * 1e300, ROWS[:, :3], ROWS[0], ROWS[:0], ROWS[None], ROWS.astype("f2"),
    ROWS.astype(">f4"), ROWS > 0, np.zeros((200_000, 7), "u1"), np.zeros((0, 2**30)), np.float64(2),
    {**ARRAY, b"shape": [2**31 - 1] * 8}, {**ARRAY, b"dtype": "O"}, {**ARRAY, b"shape": [0, 9**9]},
    {**ARRAY, b"data": "12345678"}, {b"nd": False, b"type": "<f8", b"data": bytes(8)},
    {b"__npgeneric__": True, b"data": 1e308, b"dtype": "<f2"}, {b"complex": True, b"data": "1j"},
    msgpack.ExtType(5, b"x" * 9), msgpack.Timestamp(2**33, 5), {"a" * n: n for n in range(1000)},
)  # fmt: skip


def other_message(data: bytes, rng: Random) -> bytes:
    """Give a request another field, value or name, or an episode with other bytes."""
    try:
        message = wire.unpack_json(data) if data.startswith(b"{") else wire.unpack(data)
    except InputError:
        return data[:-1]
    if not isinstance(message, dict) or rng.random() < 0.1:
        message = rng.choice(VALUES)
    elif rng.random() < 0.2:
        message["episode"] = rng.choice(BYTES + ARCHIVE)(_episode(), rng)
    else:
        names = {field for fields in REQUESTS.values() for field in fields}
        name = rng.choice((*message, *message, *sorted(names), "point_px", "", "request"))
        value = rng.choice((*VALUES, *REQUESTS, "request") if name == "request" else VALUES)
        message[name] = value
    if data.startswith(b"{"):
        return _to_json(message)
    return msgpack.packb(message, default=wire._packed)


# Frames of a websocket


def frame(payload: bytes, *, first: int = 0x82, length: int | None = None) -> bytes:
    """Return a frame of a client, which may claim another length; its mask is zero."""
    length = len(payload) if length is None else length
    if length < 126:
        return struct.pack("!BB4x", first, 0x80 | length) + payload
    return struct.pack("!BBQ4x", first, 0x80 | 127, length) + payload


@functools.cache
def _server() -> tuple[Any, int, list[str]]:
    """Return a service, its port and the errors that uvicorn logs."""
    from tests.unit.interactive.server.served import run

    service, port, _ = run(Path(tempfile.mkdtemp()))
    errors: list[str] = []
    handler = logging.Handler(logging.ERROR)
    handler.emit = lambda record: errors.append(logging.Formatter().format(record))
    logging.getLogger("uvicorn.error").addHandler(handler)
    return service, port, errors


def make_frames(folder: Path) -> None:
    """Write a step in one frame, a ping, and a saved start in two frames."""
    step, save = (wire.pack(_messages()[name]) for name in ("step", "save"))
    frames = [frame(step), frame(b"hello", first=0x89)]
    frames += [frame(save[:9], first=0x02), frame(save[9:], first=0x80)]
    (folder / "client.bin").write_bytes(b"".join(frames))


def read_frames(folder: Path) -> Any:
    """Send the frames and then a request; the server replies, closes, or waits for the rest."""
    service, port, errors = _server()
    errors.clear()
    if SESSION not in service.store.sessions:
        service.store.create({"session": SESSION, "seed": 3})
    before, last = _internal(service), frame(wire.pack({"request": "status"}))
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        head = "GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        client.sendall((head + key).encode())
        with suppress(OSError):
            client.sendall((folder / "client.bin").read_bytes() + last)
        _listen(client, service)
    assert not errors, "\n".join(errors)
    assert _internal(service) == before, "an internal error"
    for name in set(service.store.sessions) - {SESSION}:
        service.store.remove({"session": name}).result()
    return "done"


def _internal(service: Any) -> float | None:
    """Return the number of internal errors so far."""
    counted = service.metrics.registry.get_sample_value
    return counted("egosim_refused_total", {"code": "internal"})


def _listen(client: socket.socket, service: Any) -> None:
    """Receive until the reply to the last request, the end, or silence of an idle server."""
    client.settimeout(0.2)
    received, until = b"", time.monotonic() + 60
    with suppress(OSError):
        while b"damaged" not in received:
            try:
                data = client.recv(1 << 20)
            except TimeoutError:
                if service._active == 0 and received:
                    return
                assert time.monotonic() < until, "no reply in 60 s"
                continue
            if not data:
                return
            received += data


def other_frames(data: bytes, rng: Random) -> bytes:
    """Send a hostile message, or frames against the protocol."""
    names = sorted(_messages())
    message = wire.pack(_messages()[rng.choice(names)])
    changed = other_message(message, rng)
    odd = (
        frame(changed),
        frame(changed),
        frame(changed, first=rng.randrange(256)),
        frame(message[:50], length=rng.choice((51, 1 << 20, 1 << 31, 1 << 62, (1 << 64) - 1))),
        struct.pack("!BB", 0x82, 50) + message[:50],
        frame(message[:1], first=0x02) + frame(b"", first=0x00) * rng.choice((1, 5000)),
        frame(message, first=0x02) + frame(message),
        frame(b"x" * rng.choice((5, 126)), first=rng.choice((0x89, 0x8A, 0x09))),
        frame(b"", first=0x89) * 2000,
        frame(rng.choice((b"", b"\x03", b"\x03\xe8", b"\x03\xe7", b"\x03\xe8\xff")), first=0x88),
        frame(rng.choice((b"\xff\xfe", b"{}", b"x" * 10**6)), first=0x81),
        frame(bytes(17 << 20) if rng.random() < 0.1 else b""),
        frame(message)[: rng.randrange(2, 12)],
        b"GET / HTTP/1.1\r\n\r\n" * rng.choice((1, 3000)),
    )
    return b"".join(rng.choice(odd) for _ in range(rng.choice((1, 1, 2, 5))))


TARGETS = [
    Target(
        name="message",
        make=_make,
        read=_read,
        files=("*.bin", "*.json"),
        lossy="a changed message may be another valid one",
        mutations=(json_value, *(other_message,) * 4),
    ),
    Target(
        name="websocket",
        make=make_frames,
        read=read_frames,
        files=("client.bin",),
        lossy="a client may send what it likes",
        mutations=(other_frames,) * 6,
    ),
]
