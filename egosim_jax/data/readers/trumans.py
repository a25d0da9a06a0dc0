"""TRUMANS: motions of humans in rooms, which cannot be imported, and why.

Its bodies are parameters of SMPL-X, a model whose license does not allow to ship it, and it has no
egocentric videos: they would have to be rendered from its Blender files.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from egosim_jax.data.readers import Entry
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class Trumans:
    """TRUMANS, which is refused."""

    dataset: ClassVar[str] = "trumans"
    source: Annotated[Path, tyro.conf.Positional]
    """Folder of the set."""

    def find(self) -> Iterator[Entry]:
        """Refuse TRUMANS, whose bodies are parameters of SMPL-X, without egocentric video."""
        raise InputError(
            f"{self.source} cannot be imported: TRUMANS has no egocentric video, and its bodies "
            "are parameters of SMPL-X, whose license does not allow to ship the model. Render a "
            "head camera and export 21 keypoints per hand in the world with your own SMPL-X, and "
            "write them with egosim_jax.data.recording.Recording.save."
        )
