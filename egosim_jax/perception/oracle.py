"""Perception that is told the truth: for tests, and as the upper bound of any other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int32

from egosim_jax.geometry import invert
from egosim_jax.perception import Backends
from egosim_jax.types import Action, Cameras, Clip, SceneState


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Truth:
    """All that is true of a clip."""

    cameras: Cameras
    depth_m: Float32[np.ndarray, "f h w"]
    object_ids: Int32[np.ndarray, "f h w"]
    """As in `Perceived`."""
    names: Mapping[int, str]
    world_from_body: Mapping[int, Float[np.ndarray, "f 4 4"]]
    """Pose of every thing, in coordinates of its own, whichever they are."""


def oracle(truth: Truth) -> Backends:
    """A perception that reads every clip of this action as the truth.

    A thing is tracked if it moves at all.
    """

    def tracking(clip: Clip, action: Action, state: SceneState) -> dict[int, np.ndarray]:
        found = {}
        for number, path in truth.world_from_body.items():
            if not np.array_equal(path, np.broadcast_to(path[0], path.shape)):
                before = state.world_from_object.get(number, np.eye(4))
                found[number] = path @ invert(path[0]) @ before
        return found

    return Backends(
        poses=lambda clip, action, state: truth.cameras,
        depth=lambda clip, action, state: truth.depth_m,
        segmentation=lambda clip, action, state: truth.object_ids,
        tracking=tracking,
        naming=lambda clip, action, state: truth.names,
    )
