"""UmeTrack's hand model: keypoints from joint angles, as in HOT3D's annotations.

Each of five fingers, thumb first, has four hinges: hinge i rotates about an axis through a point of
the hand at rest. A keypoint is a weighted mean over its bones: the wrist (bones 0 and 1), and the
frames after the second, third and fourth hinge of each finger. The model is a left hand in
millimeters; a right hand is mirrored in x. Source: Han et al., UmeTrack, 2022. Followed: Meta's
hand_tracking_toolkit of 2025.

The model's thumb has two joints where ours has three. Our joint at the base of the thumb is the
pivot of its first hinge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.geometry import hinge_rotation
from egosim_jax.io.bounded import quote
from egosim_jax.types import InputError

FINGERS, HINGES, BONES, LANDMARKS = 5, 4, 17, 21
ORDER = (5, -1, 6, 7, 0, 8, 9, 10, 1, 11, 12, 13, 2, 14, 15, 16, 3, 17, 18, 19, 4)
"""Landmark of each of our 21 keypoints; -1 is the base of the thumb."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class HandModel:
    """Shape of the wearer's hands."""

    axes: Float[np.ndarray, "20 3"]
    """Unit vector of each hinge."""
    pivots_m: Float[np.ndarray, "20 3"]
    """Point on the axis of each hinge, at rest, in the frame of the wrist."""
    landmarks_m: Float[np.ndarray, "21 3"]
    """Landmarks of the hand at rest, in meters."""
    weights: Float[np.ndarray, "21 k"]
    """Weights of the bones that each landmark follows."""
    bones: Int[np.ndarray, "21 k"]
    """Bones that each landmark follows."""

    @classmethod
    def from_json(cls, written: Any) -> HandModel:
        """Return the model of a JSON object. Raises `InputError` if it is not one."""
        count = FINGERS * HINGES
        bones = _table(written, "landmark_rest_bone_indices", LANDMARKS, None)
        if not ((bones >= 0) & (bones < BONES)).all():
            raise InputError(f"A hand model names bones outside 0 to {BONES - 1}.")
        return cls(
            axes=_table(written, "joint_rotation_axes", count, 3),
            pivots_m=_table(written, "joint_rest_positions", count, 3) / 1000,
            landmarks_m=_table(written, "landmark_rest_positions", LANDMARKS, 3) / 1000,
            weights=_table(written, "landmark_rest_bone_weights", LANDMARKS, bones.shape[1]),
            bones=bones.astype(int),
        )

    def keypoints(
        self, angles: Float[np.ndarray, " a"], world_from_wrist: Float[np.ndarray, "4 4"], side: int
    ) -> Float[np.ndarray, "21 3"]:
        """Return our 21 keypoints in the world; `side` is 0 for a left and 1 for a right hand."""
        wrist = np.array(world_from_wrist, float)
        if side == 1:
            wrist[:3, 0] *= -1
        bones = [wrist, wrist]
        for finger in range(FINGERS):
            frame = wrist
            for hinge in range(HINGES):
                number = HINGES * finger + hinge
                frame = frame @ hinge_rotation(
                    self.axes[number], self.pivots_m[number], angles[number]
                )
                if hinge:
                    bones.append(frame)
        follow = np.stack(bones)[self.bones]
        moved = np.einsum("lkij,lj->lki", follow[..., :3, :3], self.landmarks_m)
        moved = ((moved + follow[..., :3, 3]) * self.weights[..., None]).sum(axis=1)
        base = wrist[:3, :3] @ self.pivots_m[0] + wrist[:3, 3]
        return np.concatenate([moved, base[None]])[list(ORDER)]


def _table(written: Any, name: str, rows: int, columns: int | None) -> np.ndarray:
    """Return the first `rows` rows of a table of finite numbers."""
    value = written.get(name) if isinstance(written, Mapping) else None
    try:
        table = np.array(value, float)
    except (TypeError, ValueError):
        table = np.zeros((0, 0))
    width = table.shape[-1] if table.ndim == 2 and len(table) >= rows else 0
    fits = 0 < width <= BONES and columns in (None, width)
    if not fits or not np.isfinite(table[:rows]).all():
        raise InputError(
            f"A hand model's {name} is {quote(value)}: it must have {rows} rows of "
            f"{columns or 'some'} finite numbers."
        )
    return table[:rows]
