"""Windows of clips to generate, and the file of their results.

The last line of an id in results.jsonl is the valid one.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egosim_jax.data.clip_files import ClipFiles, is_safe_id
from egosim_jax.io.bounded import quote_path, read_lines
from egosim_jax.io.digest import sha256
from egosim_jax.types import InputError

RESULTS = "results.jsonl"
"""File of the results in a folder of generated clips."""


@dataclass(frozen=True, eq=False)
class Window:
    """A window of a clip, and the id of the generated clip."""

    files: ClipFiles
    """Files of the clip."""
    start: int
    """First frame of the window in the clip."""
    output_id: str
    """Name of the output files, without suffix."""

    @property
    def split(self) -> str:
        """Split of the metadata, or "all"."""
        return self.files.extra.get("split", "all")


def windows_of(clips: Iterable[ClipFiles], starts: Sequence[int]) -> list[Window]:
    """Return the windows of all clips that start at the frames `starts`.

    With several starts, the ids are {video_id}_{start}.
    """
    several = len(starts) > 1
    return [
        Window(files, start, f"{files.video_id}_{start}" if several else files.video_id)
        for files, start in itertools.product(clips, starts)
    ]


def read_results(folder: Path) -> dict[str, dict[str, Any]] | None:
    """Read the last result of each id in a folder of generated clips; None if it has no results."""
    path = folder / RESULTS
    if not path.is_file():
        return None
    results = {}
    for number, line in read_lines(path):
        if not _is_result(line):
            raise InputError(
                f"{quote_path(path)}, line {number} is not a result: it needs a valid video_id, a "
                "source_id, a status and an integer start."
            )
        results[line["video_id"]] = line
    return results


def _is_result(line: Any) -> bool:
    texts = ("video_id", "source_id", "status")
    return (
        isinstance(line, dict)
        and all(isinstance(line.get(name), str) for name in texts)
        and is_safe_id(line["video_id"])
        and type(line.get("start")) is int
    )


def conditions_sha256(files: ClipFiles) -> str:
    """Return one SHA-256 of a clip's condition files: the hash of each existing file by role."""
    roles = {
        "prior": files.prior,
        "mask": files.mask,
        "hands": files.hands,
        "first_frame": files.first_frame,
    }
    hashes = {role: sha256(path) for role, path in roles.items() if path and path.exists()}
    return hashlib.sha256(json.dumps(hashes).encode()).hexdigest()
