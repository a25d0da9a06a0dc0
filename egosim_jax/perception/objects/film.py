"""Frames of a clip, and the objects and motions that are compared with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from egosim_jax.geometry import invert, pixels_of, transform
from egosim_jax.types import Cameras, SceneState
from egosim_jax.types.arrays import Colors, Plane, Poses
from egosim_jax.types.motion import ObjectPath


@dataclass(frozen=True, kw_only=True)
class ColorCost:
    """Color difference under the best-fitting light, because a held object may be in shadow."""

    max_residual: float = 90.0
    """Limit to which differences are clipped, in 8-bit levels."""
    unknown_residual: float = 40.0
    """Difference of a pixel without a predicted color, in 8-bit levels."""
    min_light: float = 0.45
    """Minimum light on the object, relative to the state's."""
    max_light: float = 1.2
    """Maximum light on the object, relative to the state's."""

    def apart(
        self, shown: Float32[np.ndarray, "*#n 3"], expected: Float32[np.ndarray, "*#n 3"]
    ) -> Float32[np.ndarray, "*n"]:
        """Return color differences in 8-bit levels; those from an expected color of NaN are NaN."""
        strength = np.maximum((expected**2).sum(axis=-1), 1)
        light = np.clip((shown * expected).sum(axis=-1) / strength, self.min_light, self.max_light)
        return np.sqrt(np.square(shown - light[..., None] * expected).mean(axis=-1))

    def mean(self, shown: Colors, expected: Colors) -> float:
        """Return the mean color difference in 8-bit levels; an expected color of NaN is unknown."""
        gaps = self.apart(shown, expected)
        gaps = np.where(np.isnan(gaps), self.unknown_residual, gaps)
        return float(np.minimum(gaps, self.max_residual).mean())


@dataclass(frozen=True, kw_only=True)
class ObjectModel:
    """An object instance of the state and the plane that supports it."""

    number: int
    """Id of the object instance."""
    points_m: Float[np.ndarray, "n 3"]
    colors: Float32[np.ndarray, "n 3"]
    plane: Float[np.ndarray, " 4"]
    """Supporting plane a x + b y + c z + d = 0; its unit normal points up."""

    @classmethod
    def of(cls, state: SceneState, number: int, plane: Plane) -> ObjectModel:
        """Return the model of a state's object."""
        chosen = state.object_ids == number
        return cls(
            number=number,
            points_m=state.points_m[chosen].astype(float),
            colors=state.colors[chosen].astype(np.float32),
            plane=plane,
        )


@dataclass(frozen=True, kw_only=True)
class ObjectMotion:
    """Motion of an object that hands cause between two frames."""

    model: ObjectModel
    grasped: int
    """Frame in which the hands begin to act."""
    released: int
    """Frame in which they end."""
    path: Float[np.ndarray, "f 4 4"]
    """World motion in each frame, relative to the pose before the clip."""
    lands: bool = False
    """True if the object ends on a surface, so that its height is certain."""

    @classmethod
    def of(cls, model: ObjectModel, path: ObjectPath) -> ObjectMotion:
        """Return the motion of an object on a predicted path."""
        causes = [cause for cause in path.causes if cause.how != "dropped"] or path.causes
        hows, released = [cause.how for cause in causes], max(cause.end for cause in causes)
        put_down = released < len(path.motion) - 1 or hows[-1] == "pushed"
        return cls(
            model=model,
            grasped=min(cause.begin for cause in causes),
            released=released,
            path=path.motion,
            lands=put_down and "hinged" not in hows,
        )

    @property
    def carried(self) -> Float[np.ndarray, " f"]:
        """Fraction of the frames between grasp and release that has passed at each frame."""
        frames = np.arange(len(self.path)) - self.grasped
        return np.clip(frames / (self.released - self.grasped), 0, 1)


@dataclass(frozen=True, kw_only=True)
class Film:
    """Frames of a clip with known cameras."""

    cameras: Cameras
    shown: Float32[np.ndarray, "f h w 3"]
    """Colors in 8-bit levels."""
    hidden: Bool[np.ndarray, "f h w"]
    """Pixels that hands cover; they are not compared."""
    color: ColorCost
    """Comparison of colors."""

    def at(self, frames: Int[np.ndarray, " g"] | Sequence[int]) -> Film:
        """Return some frames of the film."""
        cameras = replace(self.cameras, world_from_camera=self.cameras.world_from_camera[frames])
        return replace(self, cameras=cameras, shown=self.shown[frames], hidden=self.hidden[frames])

    def residuals(
        self, model: ObjectModel, path: Poses, *, every: int = 1
    ) -> Float[np.ndarray, "f n"]:
        """Return the color difference of each, or every n-th, point; NaN where it is not seen."""
        poses = invert(self.cameras.world_from_camera) @ path
        row, column, inside = pixels_of(self.cameras, transform(poses, model.points_m[::every]))
        frame = np.broadcast_to(np.arange(len(path))[:, None], row.shape)
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        gaps = self.color.apart(self.shown[frame, row, column], model.colors[::every])
        return np.where(inside & ~self.hidden[frame, row, column], gaps, np.nan)


def at_rest(count: int) -> Poses:
    """Return the path of an object that does not move."""
    return np.repeat(np.eye(4)[None], count, axis=0)
