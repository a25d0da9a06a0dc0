"""The journal of a run: one line per finished phase, with the file it wrote and its hash.

    {"phase": "run", "made_of": {"state": "3f...", "seed": "0", ...}, "chain": "..."}
    {"phase": "1 action", "made_of": {"action": "9a..."}, "chain": "..."}
    {"phase": "1 generate", "file": "clip_1/frames.npz", "sha256": "...", "seconds": 2.1, ...}

A line is appended when its file is complete and on disk, so a killed run resumes at the interrupted
phase. `made_of` records the hashes of a run's inputs, so another run in the folder is refused.
`chain` hashes the previous line and this one, so a changed, missing or reordered line is detected.
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from egosim_jax.io.atomic import append_line
from egosim_jax.io.bounded import listing, quote, read_lines
from egosim_jax.io.digest import sha256
from egosim_jax.runtime.options import option_of
from egosim_jax.types import InputError

T = TypeVar("T")
NAME = "journal.jsonl"
MAX_BYTES = 64 << 20
_DIGEST = re.compile(r"\b([0-9a-f]{8})[0-9a-f]{24,}\b")


class Journal:
    """Journal of the finished phases of a run, in the run's folder.

    Raises `InputError` if it is damaged, or missing although a file matches one of `outputs`, globs
    of files that only a journaled run writes.
    """

    def __init__(self, folder: Path, *, outputs: tuple[str, ...] = ()):
        self._folder = folder
        self._path = folder / NAME
        self._chain = ""
        self.done: dict[str, dict[str, Any]] = {}
        if self._path.exists():
            for number, entry in read_lines(self._path, limit=MAX_BYTES):
                self._read(number, entry)
        elif left := [path.name for glob in outputs for path in folder.glob(glob)]:
            raise InputError(
                f"{self._path} is missing, although {sorted(left)[0]} exists: without it the run "
                f"cannot be resumed. Restore it, or remove {folder} to start over."
            )

    def _read(self, number: int, entry: Any) -> None:
        chain = entry.pop("chain", None) if isinstance(entry, dict) else None
        if chain is None or not _is_entry(entry) or chain != _chained(self._chain, entry):
            raise InputError(
                f"{self._path}, line {number} was changed or is missing. Restore it, or remove "
                f"{self._folder} to start over."
            )
        self._chain, self.done[entry["phase"]] = chain, entry

    def require(self, phase: str, made_of: Mapping[str, str]) -> None:
        """Record the inputs of a run, or of a phase, as hashes or short values.

        Raises `InputError` with both values if an input differs from the recorded one.
        """
        if phase not in self.done:
            self._append({"phase": phase, "made_of": dict(made_of)})
            return
        recorded = self.done[phase]["made_of"]
        differing = {
            name: (quote(recorded.get(name)), quote(made_of.get(name)))
            for name in sorted(recorded.keys() | made_of.keys())
            if recorded.get(name) != made_of.get(name)
        }
        if differing:
            raise InputError(
                f"{self._folder} holds another run (phase {phase} in {NAME}). Choose another "
                f"folder (--out), or the same inputs: {describe(differing)}."
            )

    def check_inputs(self, phase: str, made_of: Mapping[str, str]) -> None:
        """Raise `InputError` unless these inputs of a finished phase are the recorded ones."""
        recorded = self.done.get(phase, {}).get("made_of", {})
        if differing := [name for name, value in made_of.items() if recorded.get(name) != value]:
            raise InputError(
                f"{self._path}: the {' and '.join(differing)} of phase {quote(phase)} changed "
                "after it was made. Restore the files."
            )

    def phase(
        self,
        name: str,
        output: Path,
        *,
        make: Callable[[], T],
        save: Callable[[Path, T], None],
        load: Callable[[Path], T],
        about: Callable[[], Mapping[str, Any]] = dict,
    ) -> T:
        """Run a phase, or load its recorded result; `about` returns more to record.

        A new result is saved, recorded and loaded back, so that an interrupted and an
        uninterrupted run continue from the same bytes. Raises `InputError` if the file of a
        finished phase is missing or changed.
        """
        if name in self.done:
            self.verify(name, output)
            return load(output)
        then = time.monotonic()
        output.parent.mkdir(parents=True, exist_ok=True)
        save(output, make())
        self._append(
            {
                "phase": name,
                "file": str(output.relative_to(self._folder)),
                "sha256": digest(output),
                "seconds": round(time.monotonic() - then, 3),
                **about(),
            }
        )
        return load(output)

    def verify(self, name: str, output: Path) -> None:
        """Raise `InputError` unless the file of a phase is there as the phase wrote it."""
        if not output.exists() or digest(output) != self.done.get(name, {}).get("sha256"):
            raise InputError(
                f"{output} is not the file that phase {name} wrote: it is missing or was "
                f"changed. Restore it, or remove {self._folder} to start over."
            )

    def _append(self, entry: dict[str, Any]) -> None:
        self._chain = _chained(self._chain, entry)
        append_line(self._path, {**entry, "chain": self._chain})
        self.done[entry["phase"]] = entry


def _is_entry(entry: Any) -> bool:
    """Return True if a line has the fields of a phase: its chain can be right in any file."""
    if not isinstance(entry, dict) or not isinstance(entry.get("made_of", {}), dict):
        return False
    return isinstance(entry.get("phase"), str)


def _chained(chain: str, entry: Any) -> str:
    return hashlib.sha256(f"{chain}{json.dumps(entry)}".encode()).hexdigest()[:32]


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, or of the names and hashes of a folder's files."""
    if path.is_dir():
        lines = [f"{file.name} {digest(file)}\n" for file in sorted(path.iterdir())]
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    return sha256(path)


def describe(differing: Mapping[str, tuple[str, str]]) -> str:
    """Return one line of the values that the folder has and this run has, by dotted path.

    Options of the command come first, by their names on the command line, and digests last, cut
    to 8 digits. Several fields that follow from one option are one difference.
    """
    shortest: dict[str, tuple[tuple[bool, bool, int], str]] = {}
    for path, (folder, ours) in differing.items():
        option, text = option_of(path), f"the folder has {folder}, this run has {ours}"
        short = _DIGEST.sub(r"\1…", text)
        name, rank = option or path, (option is None, short != text, len(short))
        shortest[name] = min(shortest.get(name, (rank, short)), (rank, short))
    ordered = sorted(shortest.items(), key=lambda item: item[1])
    return listing([f"{name}: {text}" for name, (_, text) in ordered])
