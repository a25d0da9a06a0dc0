"""Fuzzing targets: saved sessions of a server, as they are, damaged, and edited with care."""

from __future__ import annotations

import hashlib
import json
import tempfile
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from egosim_jax.data.shards import ShardReader
from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server import dataset_export
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.session import SEAL
from egosim_jax.interactive.server.store import Store
from egosim_jax.io import journal
from egosim_jax.io.digest import fingerprint
from egosim_jax.types import WAN_GRID, InputError
from tests.fuzz.mutations import json_value
from tests.fuzz.outside import place_special
from tests.fuzz.target import Target
from tests.painted import painted

SEALS = ("sha256", "version", "points", "description_sha256")
"""Fields of a state's description that its seal does not cover."""


def make(folder: Path) -> None:
    """Write a session with a step, a saved start, another step, a reset and a step."""
    store = Store(folder, painted(), Limits())
    rows = store.create({"seed": 3, "session": "one"}).actions.rest + 0.02 * np.eye(7)[1][None]
    for number in (1, 2, 3):
        if number == 3:
            store.reset({"session": "one", "seed": 4}).result()
        store.step({"session": "one", "step_id": number, "actions": rows}).result()
        store.save({"session": "one", "name": "a"}).result()
    store.close()


def read(folder: Path) -> Any:
    """Resume the session, load its saved start, and export its steps as training clips."""
    refused = []
    for use in (resume, export):
        try:
            clips = use(folder)
        except InputError as error:
            refused.append(error)
    if refused:
        raise refused[0]
    return clips


def resume(folder: Path) -> None:
    """Open the session as a server does after a restart."""
    store = Store(folder, painted(), Limits())
    try:
        for name in store.damaged:
            store.get(name)
        store.load({"session": "one", "name": "a"}).result()
    except RequestError as error:
        if error.code == "internal":
            raise (error.__cause__ or error) from None
        raise
    finally:
        store.close()


def export(folder: Path) -> Any:
    """Return the exported clips; their rows are in bounds, their frames of one size."""
    sessions, _ = dataset_export.open_sessions(folder, ["one"])
    (session,) = sessions
    steps = [number for _, numbers in session.runs() for number in numbers]
    rows = [session.actions.check(session.rows(n), max_rows=5) for n in steps]
    with tempfile.TemporaryDirectory() as out:
        dataset_export.to_shards(sessions, Path(out) / "shards", grid=WAN_GRID)
        records = [(r.arrays, r.metadata) for r in ShardReader(Path(out) / "shards")]
    return rows, records


VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 3, 9.0, 1e308, float("nan"), float("inf"), 2**31, 2**63, 10**20, 10**6, "",
    "x" * 5000, "\x1b[31m", "human", [], {}, [[]], [0.0] * 7, [1] * 5000, "3", "../..", 0.1,
)  # fmt: skip


def edit_json(folder: Path, rng: Random) -> None:
    """Change a value of a JSON file, and the hash that seals it."""
    file = rng.choice(sorted(folder.rglob("*.json")))
    fields = json.loads(file.read_text())
    at, key = fields, rng.choice(sorted(fields))
    while isinstance(at[key], list | dict) and at[key] and rng.random() < 0.8:
        at = at[key]
        key = rng.choice(sorted(at)) if isinstance(at, dict) else rng.randrange(len(at))
    old = at[key]
    at[key] = rng.choice(VALUES)
    if isinstance(old, int | float) and rng.random() < 0.5:
        at[key] = rng.choice((-old, 2 * old, old + 1, old + 0.05, 176, 30, 1000 * old))
    elif isinstance(old, list) and rng.random() < 0.5:
        at[key] = rng.choice((old[:-1], old * 2, old[::-1], [old], old * 300))
    elif isinstance(old, dict) and rng.random() < 0.5:
        at[key] = {**old, "more": 1}
    seal(fields)
    file.write_text(json.dumps(fields))


def seal(fields: dict[str, Any]) -> None:
    """Write the right hash into the fields of a session, a request or a state."""
    if "description_sha256" in fields:
        described = {name: value for name, value in fields.items() if name not in SEALS}
        text = json.dumps(described, sort_keys=True)
        fields["description_sha256"] = hashlib.sha256(text.encode()).hexdigest()
    elif SEAL in fields:
        del fields[SEAL]
        fields[SEAL] = fingerprint(fields)


def edit_arrays(folder: Path, rng: Random) -> None:
    """Change the frames of a clip or the points of a state, and the hashes of the file."""
    file = rng.choice(sorted(folder.rglob("*.npz")))
    with np.load(file) as stored:
        arrays = dict(stored)
    name = rng.choice(sorted(arrays))
    value = arrays[name]
    changes = (value[:-1], value[:0], value[..., :2], np.concatenate([value] * 3), value[None],
               value.astype(float) * np.nan, value.astype(np.float32), value[..., :1], value * 0,
               np.zeros((1 << 20, 3), value.dtype), value[::-1], value + value.dtype.type(90),
               np.full_like(value, 1e30 if value.dtype.kind == "f" else 99))  # fmt: skip
    arrays[name] = rng.choice(changes)
    rng.choice((np.savez, np.savez, np.savez_compressed))(file, **arrays)
    described = file.parent / "state.json"
    if described.exists():
        fields = json.loads(described.read_text())
        fields["sha256"] = journal.digest(file)
        fields["points"] = len(arrays["points_m"])
        described.write_text(json.dumps(fields))
    for path in folder.rglob(journal.NAME):
        rewrite(path)


def rewrite(path: Path) -> None:
    """Write a journal again with the hashes of its files, and its chain."""
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    path.unlink()
    written = journal.Journal(path.parent)
    for entry in entries:
        del entry["chain"]
        if "file" in entry:
            entry["sha256"] = journal.digest(path.parent / entry["file"])
        written._append(entry)


TARGETS: list[Target] = [
    Target(
        name="damaged session",
        make=make,
        read=read,
        files=("one/**/*",),
        sealed=True,
        mutations=(json_value,),
        rearrangements=(place_special,),
    ),
    Target(
        name="edited session",
        make=make,
        read=read,
        files=("one/**/*",),
        lossy="whoever edits a session can seal it again",
        rearrangements=(edit_json, edit_json, edit_json, edit_arrays) * 4,
    ),
]
