"""TRUMANS: human motions in rooms, which cannot be imported.

Its bodies are parameters of SMPL-X, whose license forbids shipping the model. It has no egocentric
videos; they would have to be rendered from its Blender files. The reader exists to say this.
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
    """Folder of the dataset."""

    def find(self) -> Iterator[Entry]:
        """Raise `InputError`, which explains why TRUMANS cannot be imported."""
        raise InputError(
            f"{self.source} cannot be imported: TRUMANS has no egocentric video, and its bodies "
            "are parameters of SMPL-X, whose license forbids shipping the model. Render a "
            "head camera and export 21 keypoints per hand in the world with your own SMPL-X, and "
            "write them with egosim_jax.data.recording.Recording.save."
        )
