"""Reading a clip back into 3D: who says where the cameras were, how far things are, what they are.

Each part is a Protocol that is called with the clip, the action and the state before it; `Backends`
puts the parts together. Backends know what the generator was given and what it gave, never the
truth; the exception is `oracle`, for tests and upper bounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, Int32

from egosim_jax.state.filter import touched
from egosim_jax.types import Action, Cameras, Clip, InputError, Perceived, SceneState


@runtime_checkable
class Perception(Protocol):
    """Reads a clip, given what was done in it and what was known before."""

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Perceived:
        """What the clip shows, in the world."""
        ...


@runtime_checkable
class Poses(Protocol):
    """Where the camera was."""

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Cameras:
        """One pose a frame, in the world."""
        ...


@runtime_checkable
class Depth(Protocol):
    """How far things are."""

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Float32[Any, "f h w"]:
        """Meters along the camera's axis; infinite where unknown."""
        ...


@runtime_checkable
class Segmentation(Protocol):
    """Which pixels belong to which thing."""

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Int32[Any, "f h w"]:
        """Ids: 0 background, negative hands and arms, those of the state where it knows them."""
        ...


@runtime_checkable
class Tracking(Protocol):
    """How the things that moved have moved."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState
    ) -> Mapping[int, Float[Any, "f 4 4"]]:
        """`world_from_object` by id, from the pose in the state on; nothing for those at rest."""
        ...


@runtime_checkable
class Hands(Protocol):
    """Where the hands' joints are."""

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Float[Any, "f n j 3"]:
        """Joints in the world; NaN for a hand that is missing."""
        ...


@runtime_checkable
class Naming(Protocol):
    """What the things are called."""

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Mapping[int, str]:
        """Names by id."""
        ...


@dataclass(frozen=True, kw_only=True)
class Backends:
    """A perception put together of parts."""

    poses: Poses
    depth: Depth
    segmentation: Segmentation
    tracking: Tracking
    naming: Naming

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Perceived:
        """Ask every part; which things were acted on follows from ids and depth."""
        asked = clip, action, state
        depth, ids, names = self.depth(*asked), self.segmentation(*asked), self.naming(*asked)
        shape = clip.frames.shape[:3]
        for what, found in (("depth", depth), ("ids", ids)):
            if found.shape != shape:
                raise InputError(
                    f"Perception gave {what} of {found.shape} for a clip of {shape}: it must be "
                    "one for each pixel of each frame."
                )
        return Perceived(
            step=state.step + 1,
            frames=clip.frames,
            cameras=self.poses(*asked),
            depth_m=np.where(np.isnan(depth), np.inf, depth).astype(np.float32),
            object_ids=ids.astype(np.int32),
            names=names,
            world_from_object=self.tracking(*asked),
            touched=touched(ids, depth, {**state.names, **names}),
        )
