"""Predicted motion of the objects of a state (`dynamics`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Float, Int

How = Literal["held", "hinged", "pushed", "carried", "dropped"]
"""Cause of a motion: in a hand, on a hinge in a hand, pushed, on a moving object, or falling."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Cause:
    """Reason for which an object moves in some consecutive frames."""

    how: How
    """Kind of the cause."""
    hand: int | None
    """Index of the hand that causes the motion, also through other objects; None for a fall."""
    begin: int
    """First frame of the cause: the object has not moved yet."""
    end: int
    """Last frame of the cause."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class ObjectPath:
    """Predicted motion of one object."""

    motion: Float[np.ndarray, "f 4 4"]
    """Rigid motion of the object's points in the world, from the first frame to each frame."""
    causes: tuple[Cause, ...]
    """Causes of the motion, in the order of their beginning."""
    confidence: float
    """Probability that the object moves so, from 0 to 1."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Motion:
    """Predicted motion of the objects of a state during an action."""

    paths: Mapping[int, ObjectPath] = field(default_factory=dict)
    """Paths of the objects that move, by id; the other objects rest."""
    held: Mapping[int, int] = field(default_factory=dict)
    """Object that each hand holds at the end, by the hand's index."""
    alternatives: tuple[Motion, ...] = ()
    """Other motions that the hands allow, the most probable first."""

    def at(self, frames: Int[np.ndarray, " n"]) -> Motion:
        """Return the paths at some frames, without causes and alternatives."""
        return Motion(
            paths={
                number: replace(path, motion=path.motion[frames], causes=())
                for number, path in self.paths.items()
            }
        )
