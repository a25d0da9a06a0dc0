"""The phases of a run that are done, one line each: what was written and its hash.

A line is added when its file is whole and on disk. So a run that is killed goes on at the phase
that was under way, and a file that was changed since is noticed.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.digest import sha256
from egosim_jax.types import InputError

T = TypeVar("T")


class Journal:
    """The journal of a run's folder."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._path = folder / "journal.jsonl"
        self.done: dict[str, dict[str, str | float]] = {}
        if self._path.exists():
            lines, _, torn = self._path.read_bytes().rpartition(b"\n")
            if torn:  # the run was killed in the middle of a line
                with atomic_write(self._path) as temporary:
                    temporary.write_bytes(lines + b"\n" if lines else b"")
            for line in lines.splitlines():
                entry = json.loads(line)
                self.done[entry["phase"]] = entry

    def phase(
        self,
        name: str,
        output: Path,
        *,
        make: Callable[[], T],
        save: Callable[[Path, T], None],
        load: Callable[[Path], T],
    ) -> T:
        """What the phase gives: read if it is done, else made, written and entered.

        What is made is read back from what was written, so that a run that was interrupted and one
        that was not go on from the same. Raises `InputError` if a file of a finished phase is
        missing or changed.
        """
        if name in self.done:
            if not output.exists() or digest(output) != self.done[name]["sha256"]:
                raise InputError(
                    f"{output} is not what the run wrote in phase {name}: it is missing or was "
                    f"changed. Bring it back, or remove {self._path} to start over."
                )
            return load(output)
        then = time.monotonic()
        output.parent.mkdir(parents=True, exist_ok=True)
        save(output, make())
        self._enter(name, output, time.monotonic() - then)
        return load(output)

    def _enter(self, name: str, output: Path, seconds: float) -> None:
        entry = {
            "phase": name,
            "file": str(output.relative_to(self._folder)),
            "sha256": digest(output),
            "seconds": round(seconds, 3),
        }
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")
            file.flush()
            os.fsync(file.fileno())
        self.done[name] = entry


def digest(path: Path) -> str:
    """SHA-256 of a file, or of the names and hashes of a folder's files."""
    if path.is_dir():
        listing = [f"{file.name} {digest(file)}\n" for file in sorted(path.iterdir())]
        return hashlib.sha256("".join(listing).encode()).hexdigest()
    return sha256(path)
