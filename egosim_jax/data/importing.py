"""Import recordings: write what a reader finds as folders for annotation.

    DIR/<recording_id>/recording.json, arrays.npz, and for images also video.mp4 and depth/

A folder appears when its recording is complete, so a refused or interrupted one leaves nothing. A
damaged recording is imported again; one that another source or other options made is refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from egosim_jax.data.readers import NOTE, Entry, Reader
from egosim_jax.data.recorded_files import DESCRIPTION
from egosim_jax.data.recording import ARRAYS, Recording
from egosim_jax.io.atomic import atomic_folder, check_replaceable, lock_folder
from egosim_jax.io.bounded import only_inside, open_regular
from egosim_jax.runtime.terminal import check_utf8
from egosim_jax.types import InputError, check_counts

FIXED = {"camera": "fixed"}
"""Provenance of a recording whose dataset has a camera at rest."""
_FILES = re.compile(rf"{re.escape(DESCRIPTION)}|{re.escape(ARRAYS)}|video\.mp4|depth/\d+\.png")
"""Paths of the files in the folder of a recording."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of one entry of an import."""

    recording_id: str
    """Id of the recording."""
    problem: str | None = None
    """Reason why it was skipped; None if it was imported."""
    resumed: bool = False
    """True if an earlier import wrote it."""
    note: str | None = None
    """Part of its source that was imported, unless it is all."""


def import_recordings(
    reader: Reader, out: Path, *, limit: int | None = None
) -> tuple[int, Iterator[Outcome]]:
    """Return the number of recordings to import and an iterator that imports them one by one.

    The outcome of an entry that cannot be read holds its problem; the other entries are imported.
    Raises `InputError` if the source is not of the reader's dataset.
    """
    check_counts({"--limit": limit})
    sources = [value for value in vars(reader).values() if isinstance(value, Path)]
    with only_inside(sources):
        entries = list(islice(reader.find(), limit))
    return len(entries), _import(reader.dataset, entries, (*sources, out), out)


def _import(
    dataset: str, entries: Iterable[Entry], folders: Sequence[Path], out: Path
) -> Iterator[Outcome]:
    seen: dict[str, Path] = {}
    with lock_folder(out):
        for entry in entries:
            name = entry.recording_id
            try:
                if name in seen:
                    raise InputError(
                        f"{seen[name]} has the same id: ids must be unique. Import the two folders "
                        "separately."
                    )
                seen[name] = entry.source
                with only_inside(folders):
                    outcome = _import_one(dataset, entry, out / name)
                yield outcome
            except InputError as error:
                yield Outcome(recording_id=name, problem=str(error))


def _import_one(dataset: str, entry: Entry, folder: Path) -> Outcome:
    """Read and write a recording, unless an earlier import wrote it."""
    check_utf8(source := entry.source.resolve())
    made_of = {"dataset": dataset, "source": str(source), **entry.options}
    if (folder / DESCRIPTION).exists():
        try:
            written = Recording.load(folder).provenance
        except InputError:
            written = None
        if written is not None:
            differing = [n for n, value in made_of.items() if written.get(n) != value]
            if differing:
                raise InputError(
                    f"{folder} holds a recording with another {', '.join(differing)}: choose "
                    "another folder, or remove it. (--out)"
                )
            return Outcome(recording_id=entry.recording_id, resumed=True, note=written.get(NOTE))
    folder = check_replaceable(folder, _FILES, description=DESCRIPTION)
    with atomic_folder(folder) as temporary:
        recording = _without_placeholders(entry.read(temporary))
        for path in recording.depth.paths if recording.depth else ():
            if path is not None:
                open_regular(path).close()
        provenance = {**recording.provenance, **made_of}
        replace(recording, recording_id=entry.recording_id, provenance=provenance).save(temporary)
    return Outcome(recording_id=entry.recording_id, note=provenance.get(NOTE))


def _without_placeholders(recording: Recording) -> Recording:
    """Return a recording whose cameras are unknown if all poses are equal.

    A camera that a person wears or holds never rests exactly: such poses fill a required field.
    The camera of a robot may rest, and so may one that its dataset calls fixed.
    """
    poses = recording.world_from_camera
    fixed = recording.provenance.items() >= FIXED.items() or recording.kind == "robot"
    if poses is None or len(poses) < 2 or fixed or not (poses == poses[0]).all():
        return recording
    why = "unknown: all are equal, as placeholders are"
    return replace(
        recording,
        world_from_camera=None,
        joints_m=None,
        points=None,
        metric=False,
        provenance={**recording.provenance, "poses": why, NOTE: f"no cameras; poses {why}"},
    )
