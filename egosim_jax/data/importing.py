"""Import of recordings: what a reader finds is written as folders that annotation reads.

    DIR/<recording_id>/recording.json, arrays.npz, and for images also video.mp4 and depth/

A recording is done when its recording.json exists, so that an interrupted import resumes; it is
made again if it is damaged. What another source or other options made is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from egosim_jax.data.readers import Entry, Reader
from egosim_jax.data.recorded_files import DESCRIPTION
from egosim_jax.data.recording import Recording
from egosim_jax.io.atomic import lock_folder
from egosim_jax.types import InputError, check_counts


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of one entry of an import."""

    recording_id: str
    """Id of the recording."""
    problem: str | None = None
    """Reason why it was skipped; None if it was imported."""
    resumed: bool = False
    """True if an earlier import had written it."""


def import_recordings(
    reader: Reader, out: Path, *, limit: int | None = None
) -> tuple[int, Iterator[Outcome]]:
    """Return the number of recordings to import and an iterator that imports them one by one.

    An entry that cannot be read is an outcome with its problem; the others are imported. Raises
    `InputError` if the source is not of the reader's dataset.
    """
    check_counts({"--limit": limit})
    entries = list(islice(reader.find(), limit))
    return len(entries), _import(reader.dataset, entries, out)


def _import(dataset: str, entries: Iterable[Entry], out: Path) -> Iterator[Outcome]:
    seen: dict[str, Path] = {}
    with lock_folder(out):
        for entry in entries:
            name = entry.recording_id
            try:
                if name in seen:
                    raise InputError(
                        f"its id is also that of {seen[name]}: ids must be unique. Import the two "
                        "folders separately."
                    )
                seen[name] = entry.source
                yield Outcome(recording_id=name, resumed=_import_one(dataset, entry, out / name))
            except InputError as error:
                yield Outcome(recording_id=name, problem=str(error))


def _import_one(dataset: str, entry: Entry, folder: Path) -> bool:
    """Read and write a recording unless that was done; return True if it was."""
    made_of = {"dataset": dataset, "source": str(entry.source.resolve()), **entry.options}
    if (folder / DESCRIPTION).exists():
        try:
            written = Recording.load(folder).provenance
        except InputError:
            written = None
        if written is not None:
            differing = [n for n, value in made_of.items() if written.get(n) != value]
            if differing:
                raise InputError(
                    f"{folder} holds a recording of another {', '.join(differing)}: choose another "
                    "folder, or remove it. (--out)"
                )
            return True
    recording = entry.read(folder)
    provenance = {**recording.provenance, **made_of}
    replace(recording, recording_id=entry.recording_id, provenance=provenance).save(folder)
    return False
