"""Files of clips, as a metadata file or a list of DWM names them, and the problems found there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from egosim_jax.types import InputError

Prompts = Literal["prompts_rewrite", "prompts"]
"""Captions of a list of DWM: rewritten ones, with original ones in their absence, or original ones.
"""
MAX_CLIPS = 400_000
"""Maximum number of clips in a metadata file or list."""


@dataclass(frozen=True, kw_only=True)
class ClipFiles:
    """The files of a clip: one row of the metadata."""

    video_id: str
    """Unique id, which names the outputs."""
    prompt: str
    """Caption of the clip."""
    prior: Path
    """Video of the rendered scene."""
    mask: Path | None
    """Video of the mask: white where the prior shows nothing; None: it shows everything."""
    hands: Path
    """Video of the hand skeletons."""
    first_frame: Path
    """Path of the image for CLIP."""
    target: Path | None
    """Recorded video, if the metadata names one."""
    extra: Mapping[str, str]
    """Cells of further columns by column."""
    row: str
    """File and line of the row, for messages."""


class Problems:
    """First problems of a possibly long list, and their number."""

    def __init__(self, most: int = 10):
        self._most, self._shown, self._count = most, list[str](), 0

    def add(self, problems: Iterable[str]) -> None:
        """Count problems, and keep them if they are among the first."""
        for problem in problems:
            self._count += 1
            if self._count <= self._most:
                self._shown.append(problem)

    def refuse(self, what: str) -> None:
        """Raise `InputError` if there is any problem."""
        if self._count > self._most:
            self._shown.append(f"and {self._count - self._most:,} more")
        if self._count:
            raise InputError(f"{what}: {'; '.join(self._shown)}.")
