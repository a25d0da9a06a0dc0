"""Objects that moved from one state to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egosim_jax.geometry import invert, rotation_angles_deg, transform
from egosim_jax.types import SceneState
from egosim_jax.types.data import object_name

MAY_HAVE_HELD = "may have held"
"""Words of a note on a hold that only the clip shows (`perception/clip/object_motion.py`)."""
MIN_CHANGE = 1e-6
"""Minimum change of an entry of a pose that counts as motion."""


@dataclass(frozen=True, kw_only=True)
class MovedObject:
    """Motion of an object from one state to a later one."""

    object_id: int
    """Object instance."""
    name: str
    """Name of the object, or its number."""
    moved_mm: float
    """Distance between the places of its center, in millimeters."""
    turned_deg: float
    """Angle of its rotation, in degrees."""
    held: bool
    """True if a hand still holds it in the later state."""
    may_be_held: bool = False
    """True if perception does not know when the hand let go of it, or whether."""

    def __str__(self) -> str:
        """Return the motion in one line."""
        held = "and is held" if self.held else "and is released"
        if self.may_be_held and not self.held:
            held = "and may still be held"
        turned = f"turned by {self.turned_deg:.0f} degrees"
        return f"{self.name}: moved by {self.moved_mm:.0f} mm, {turned}, {held}"


def moved_objects(
    before: SceneState, after: SceneState, notes: Sequence[str] = ()
) -> list[MovedObject]:
    """Return the objects whose poses differ between two states of a scene, in order of their ids.

    An object that got its id in between is compared with where it was first observed. The center
    is the mean of the object's points in the later state. `notes` are perception's of the clip: an
    object that a hand "may have held" may still be held.
    """
    moved = []
    for number in sorted(after.world_from_object):
        points = after.points_m[after.object_ids == number]
        pose = after.world_from_object[number]
        start = before.world_from_object.get(number, np.eye(4))
        if not len(points) or np.allclose(pose, start, rtol=0, atol=MIN_CHANGE):
            continue
        after_from_before = pose @ invert(start)
        center = points.mean(axis=0, dtype=np.float64)
        earlier = transform(invert(after_from_before), center[None])[0]
        name = object_name(number, after.names)
        moved.append(
            MovedObject(
                object_id=number,
                name=name,
                moved_mm=1000 * float(np.linalg.norm(center - earlier)),
                turned_deg=float(rotation_angles_deg(after_from_before)),
                held=number in after.held.values(),
                may_be_held=any(f"{MAY_HAVE_HELD} {name}:" in note for note in notes),
            )
        )
    return moved
