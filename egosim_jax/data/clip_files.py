"""Clips as rows of a metadata file or of a DWM list: ids, files and the problems of rows."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from egosim_jax.types import InputError

Prompts = Literal["prompts_rewrite", "prompts"]
"""Captions to read from DWM's folders: rewritten (else the original), or original only."""
MAX_CLIPS = 400_000
"""Maximum number of clips in a metadata file or list."""
PRIOR_KIND = "prior_kind"
"""Column of the metadata with the kind of a clip's prior."""
SAFE_IDS = "letters, digits, '.', '_' and '-', and '/' between folders without dots"
"""Rule of a safe id, for messages."""
_SAFE_ID = re.compile(r"(?:[A-Za-z0-9_-]+/)*[A-Za-z0-9_-][A-Za-z0-9._-]*")


def is_safe_id(text: str) -> bool:
    """Return True if the id of a clip or recording is a valid file name; a `/` makes a subfolder.

    Folder names have no dots, so that an id cannot collide with another id's file.
    """
    return len(text) <= 200 and _SAFE_ID.fullmatch(text) is not None


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
    """Video of the mask, white where the prior has no pixels; None if the prior has all pixels."""
    hands: Path
    """Video of the hand skeletons."""
    first_frame: Path
    """Image for CLIP, or a video whose first frame is used."""
    target: Path | None
    """Recorded video, if the metadata names one."""
    extra: Mapping[str, str]
    """Cells of further columns, by column."""
    row: str
    """File and line of the row, for messages."""


class Problems:
    """The first problems of a possibly long list, and the number of all."""

    MAX_SHOWN = 10
    """Maximum number of problems in a message."""

    def __init__(self) -> None:
        self._shown, self._count = list[str](), 0

    def add(self, problems: Iterable[str]) -> None:
        """Count problems; keep the first `MAX_SHOWN`."""
        for problem in problems:
            self._count += 1
            if self._count <= self.MAX_SHOWN:
                self._shown.append(problem)

    def refuse(self, message: str) -> None:
        """Raise `InputError` if there are problems; the message lists them."""
        if self._count > self.MAX_SHOWN:
            self._shown.append(f"and {self._count - self.MAX_SHOWN:,} more")
        if self._count:
            raise InputError(f"{message}: {'; '.join(self._shown)}.")


def prior_column(prior: str) -> dict[str, str]:
    """Return the column of the metadata that says how priors were made; none if they are static."""
    return {} if prior == "static" else {PRIOR_KIND: prior}


def prior_problem(extra: Mapping[str, str], prior: str) -> str | None:
    """Say how a clip's prior contradicts the model's; None if it does not, or is unknown."""
    kind = extra.get(PRIOR_KIND, prior)
    if kind == prior:
        return None
    return (
        f"its prior is {kind!r}, and the model's priors are {prior}: make it again "
        f"(`egosim data annotate --prior {prior}`). (--metadata, --shards)"
    )
