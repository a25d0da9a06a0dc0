"""Poses, grips and causes while the frames of an action are walked through."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from egosim_jax.dynamics.grips import Hold
from egosim_jax.dynamics.hands import HandTrack
from egosim_jax.dynamics.solids import Solid
from egosim_jax.types.arrays import Pose
from egosim_jax.types.motion import Cause, How

SAME_POSE = 1e-6
"""Maximum difference of two matrices that are one pose."""


@dataclass(frozen=True, kw_only=True)
class Grip:
    """An object in a hand."""

    hand: int
    """Index of the hand."""
    number: int
    """Id of the object."""
    hold: Hold
    """Frames of the hold."""
    motion: Float[np.ndarray, "f 4 4"]
    """Motion of the object since the beginning of the hold."""
    how: How
    """Held or hinged."""
    start: Float[np.ndarray, "4 4"]
    """Pose of the object at the beginning of the hold."""

    def ending(self, frame: int) -> Grip:
        """Return the grip with a hold that ends in a frame."""
        return replace(self, hold=replace(self.hold, end=frame, opens=True))


@dataclass(frozen=True, kw_only=True)
class Fall:
    """A released object on its way down."""

    begin: int
    """Frame of the release."""
    height_m: float
    """Height of the fall; negative for an object that is lifted out of its support."""


@dataclass(kw_only=True)
class Walk:
    """Objects and hands in one frame. Poses are motions since the first frame."""

    solids: Mapping[int, Solid]
    """Solids of the objects, by id."""
    tracks: Mapping[int, HandTrack]
    """Tracks of the hands that are in view, in level coordinates."""
    holds: Mapping[int, list[Hold]]
    """Possible holds of each hand."""
    given: Mapping[int, int]
    """Object that each hand with a given hold has in it, whatever its fingers say."""
    held_before: Mapping[int, int]
    """Object that each hand held before the first frame."""
    ground_m: Float[np.ndarray, "n 3"]
    """Points without an id, which support objects."""
    furniture: set[int]
    """Objects that only a hand at their handle moves."""
    frame: int = 0
    """Present frame."""
    poses: dict[int, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    """Pose of each object in the present frame."""
    paths: dict[int, list[Float[np.ndarray, "4 4"]]] = field(default_factory=dict)
    """Poses of each object in the frames before."""
    grips: dict[int, Grip] = field(default_factory=dict)
    """Grip of each hand that holds an object."""
    falls: dict[int, Fall] = field(default_factory=dict)
    """Objects that fall."""
    causes: dict[int, list[Cause]] = field(default_factory=dict)
    """Causes of each object's motion so far."""
    left: set[tuple[int, int]] = field(default_factory=set)
    """Hands and the objects that they have released and not left yet."""
    around: set[tuple[int, int]] = field(default_factory=set)
    """Hands and the objects that they are around since the first frame; they may grip them."""
    pressing: set[tuple[int, int, int]] = field(default_factory=set)
    """Hand, joint and object of each joint inside an object that it does not push."""

    def __post_init__(self) -> None:
        """Begin with all objects where they are."""
        self.poses = {number: np.eye(4) for number in self.solids}
        self.paths = {number: [] for number in self.solids}

    @property
    def in_hands(self) -> set[int]:
        """Ids of the objects in hands."""
        return {grip.number for grip in self.grips.values()}

    def before(self, number: int) -> Pose:
        """Return the pose of an object in the last frame."""
        return self.paths[number][-1]

    def move(self, number: int, pose: Pose, how: How, hand: int | None) -> None:
        """Move an object to a pose, and note the cause."""
        if np.abs(pose - self.poses[number]).max() > SAME_POSE:
            self.note(number, how, hand, self.frame - 1, self.frame)
        self.poses[number] = pose

    def note(self, number: int, how: How, hand: int | None, begin: int, end: int) -> None:
        """Note a cause, or extend the last one if it is the same."""
        causes = self.causes.setdefault(number, [])
        last = causes[-1] if causes else None
        if last and last.how == how and last.hand == hand and last.end >= begin:
            causes[-1] = replace(last, end=max(end, last.end))
        else:
            causes.append(Cause(how=how, hand=hand, begin=begin, end=end))

    def next_frame(self) -> None:
        """Store the poses and go to the next frame."""
        for number, pose in self.poses.items():
            self.paths[number].append(pose)
        self.frame += 1
