"""Refinement of an object's last pose by comparing its rendering with the clip.

Coordinate descent with shrinking steps translates the object, and rotates it about the normal of
the supporting surface. A step is kept if the rendering of object and background becomes more like
the clip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from egosim_jax.geometry import cameras_in_object_frame, transform
from egosim_jax.perception.objects.film import Film, ObjectModel, ObjectMotion
from egosim_jax.rendering.reference import splat
from egosim_jax.state.fuse import dilate
from egosim_jax.types import InputError, SceneState, check_counts
from egosim_jax.types.arrays import Plane, Poses


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """Parameters of `refine_pose`."""

    steps_m: tuple[float, ...] = (0.012, 0.006, 0.003)
    """Translation step of each round in meters."""
    steps_deg: tuple[float, ...] = (12.0, 6.0, 3.0)
    """Rotation step of each round in degrees."""
    deviation_m: float | None = None
    """Translation in meters that costs 1 level; None for no such prior on the path."""
    deviation_deg: float | None = None
    """Rotation in degrees that costs 1 level; None for no such prior on the path."""
    min_frames: int = 3
    """Minimum number of compared frames at the end of the clip."""
    margin: float = 0.03
    """Compared border around the object, as a fraction of the image width."""
    point_px: int = 2
    """Size of the rendered points in pixels."""

    def __post_init__(self) -> None:
        """Check that each round has both steps, and that deviations and counts are positive."""
        if len(self.steps_m) != len(self.steps_deg):
            raise InputError(
                f"steps_m {self.steps_m} and steps_deg {self.steps_deg} must have one step per "
                "round each."
            )
        for name in ("deviation_m", "deviation_deg"):
            if (value := getattr(self, name)) is not None and value <= 0:
                raise InputError(f"{name} must be positive, or None for any, not {value}.")
        check_counts({"min_frames": self.min_frames, "point_px": self.point_px})


def refine_pose(
    best: ObjectMotion, film: Film, state: SceneState, config: Refinement
) -> ObjectMotion:
    """Return the motion with a last pose that explains the clip better.

    The motion is unchanged if hands cover the object to the end, or if the clip is more like the
    scene without the object: then it does not show it anywhere near.
    """
    frames = np.arange(len(best.path))[min(best.released, len(best.path) - config.min_frames) :]
    scene = _Neighborhood.of(best, film.at(frames), best.path[frames], state, config)
    if not scene.compared.any():
        return best
    far, turned = config.deviation_m or np.inf, np.radians(config.deviation_deg or np.inf)
    scale = np.array([far, far, far, turned])
    change, best_cost = np.zeros(4), scene.cost(best.path[frames])
    # An object that was put down stays on the surface: its height is known.
    axes = np.linalg.svd(best.model.plane[None, :3])[2][1:] if best.lands else np.eye(3)
    for meters, degrees in zip(config.steps_m, config.steps_deg, strict=True):
        steps = [*np.pad(meters * axes, [(0, 0), (0, 1)]), np.array([0, 0, 0, np.radians(degrees)])]
        improved = True
        while improved:
            improved = False
            for step in (*steps, *(-step for step in steps)):
                cost = scene.cost(perturb(best, change + step)[frames])
                cost += float(np.square((change + step) / scale).sum())
                if cost < best_cost:
                    change, best_cost, improved = change + step, cost, True
    if best_cost > scene.cost_without():
        return best
    return replace(best, path=perturb(best, change))


def perturb(best: ObjectMotion, change: Plane) -> Poses:
    """Return the path with a change that grows from the grasp to the release.

    The change is a translation in meters, and a rotation about the plane's normal through the
    object's center in radians.
    """
    import cv2

    center = transform(best.path, best.model.points_m.mean(axis=0)[None])[:, 0]
    changes = np.repeat(np.eye(4)[None], len(best.path), axis=0)
    for matrix, share, point in zip(changes, best.carried, center, strict=True):
        matrix[:3, :3] = cv2.Rodrigues(share * change[3] * best.model.plane[:3])[0]
        matrix[:3, 3] = point + share * change[:3] - matrix[:3, :3] @ point
    return changes @ best.path


@dataclass(frozen=True, kw_only=True)
class _Neighborhood:
    """Pixels around an object's last pose in some frames, and the background behind it."""

    model: ObjectModel
    film: Film
    background: Float32[np.ndarray, "f h w 3"]
    """Colors; NaN where the state has no points."""
    background_m: Float32[np.ndarray, "f h w"]
    """Depth in meters; infinite where the state has no points."""
    compared: Bool[np.ndarray, "f h w"]
    point_px: int

    @classmethod
    def of(
        cls, best: ObjectMotion, film: Film, path: Poses, state: SceneState, config: Refinement
    ) -> _Neighborhood:
        """Return the neighborhood of an object on a path in a film."""
        others = state.object_ids != best.model.number
        depth, index = splat(state.points_m[others], film.cameras, point_px=config.point_px)
        colors = state.colors[others].astype(np.float32)
        background = np.append(colors, np.full((1, 3), np.nan, np.float32), axis=0)[index]
        local = cameras_in_object_frame(film.cameras, path)
        _, drawn = splat(best.model.points_m, local, point_px=config.point_px)
        return cls(
            model=best.model,
            film=film,
            background=background,
            background_m=depth,
            compared=dilate(drawn >= 0, config.margin) & ~film.hidden,
            point_px=config.point_px,
        )

    def cost(self, path: Poses) -> float:
        """Return the mean difference between the clip and a rendering with the object on a path."""
        local = cameras_in_object_frame(self.film.cameras, path)
        depth, index = splat(self.model.points_m, local, point_px=self.point_px)
        nearer = (index >= 0) & (depth < self.background_m)
        drawn = np.where(nearer[..., None], self.model.colors[index], self.background)
        return self.film.color.mean(self.film.shown[self.compared], drawn[self.compared])

    def cost_without(self) -> float:
        """Return the mean difference between the clip and a rendering without the object."""
        shown, background = self.film.shown[self.compared], self.background[self.compared]
        return self.film.color.mean(shown, background)
