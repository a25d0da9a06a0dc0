"""Silhouettes of hands and forearms, drawn from their joints.

A hand consists of capsules around its bones, the palm between its knuckles, and an arm from the
wrist towards the wearer. The forearm of a tracked hand also continues the palm. Without a
segmentation network, this is the mask of the wearer's moving pixels. A wide sleeve is wider than
the drawn forearm.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.dynamics.hands import PALM
from egosim_jax.geometry import invert, project, transform
from egosim_jax.perception.video.estimates import HandTracks
from egosim_jax.perception.video.hands import lift
from egosim_jax.rendering.skeleton import SKELETONS
from egosim_jax.types import Cameras, Counted, Kind
from egosim_jax.types.arrays import IdMaps, Masks, Vector, Video

ASSUMED_FOCAL = 0.45
"""Focal length for drawing tracks of an uncalibrated video, in image widths.

The lifted depth is proportional to it, so the drawn hand does not depend on it, and the forearm
hardly does."""


@dataclass(frozen=True, kw_only=True)
class HandShape(Counted):
    """Size of drawn hands and forearms."""

    finger_radius_m: float = 0.013
    """Radius of a finger around its bones in meters."""
    arm_radius_m: float = 0.05
    """Radius of a forearm in meters."""
    shoulder_offset_m: tuple[float, float, float] = (0.0, 0.35, 0.05)
    """Origin of an arm in camera axes in meters; its x is an offset from the wrist."""
    arm_fraction: float = 0.8
    """Drawn fraction of the way from the wrist, or the elbow, to the arm's origin."""
    forearm_m: float | None = None
    """Length of a forearm that continues the palm; None: the arm is straight from the wrist on."""
    bend: float = 1.0
    """Weight of the direction to the arm's origin in a forearm's direction; the palm's has 1."""
    sides_m: tuple[float, float] | None = None
    """x of the origins of a left and a right arm, for hands in this order; None: the wrist's."""
    near_m: float = 0.05
    """Near limit of drawing, in meters from the camera."""
    discs: int = 25
    """Number of discs of a drawn capsule."""


TRACKED = HandShape(forearm_m=0.26, sides_m=(-0.2, 0.2))
"""Size of the tracked hands of a video."""


def track_silhouettes(frames: Video, tracks: HandTracks) -> Masks:
    """Return the pixels of tracked hands and their forearms. Cameras need not be known.

    A hand that is missing from a frame covers nothing there.
    """
    height, width = frames.shape[1:3]
    focal = ASSUMED_FOCAL * width
    center = (width - 1) / 2, (height - 1) / 2
    cameras = Cameras(
        world_from_camera=np.repeat(np.eye(4)[None], len(frames), axis=0),
        intrinsics_px=np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]]),
        height=height,
        width=width,
    )
    joints_m = lift(tracks, cameras.intrinsics_px)
    return hand_silhouette(joints_m, "human", cameras, TRACKED) >= 0


def hand_silhouette(
    joints_m: Float[np.ndarray, "f n j 3"], kind: Kind, cameras: Cameras, shape: HandShape
) -> IdMaps:
    """Return the index of the hand (forearm included) that covers each pixel; -1 for no hand.

    A hand with a joint that is not finite is not drawn.
    """
    import cv2

    covered = np.full((len(joints_m), cameras.height, cameras.width), -1, np.int32)
    bones = SKELETONS[kind].bones.tolist()
    for frame, world_from_camera in enumerate(cameras.world_from_camera):
        canvas = np.zeros((cameras.height, cameras.width), np.uint8)
        for number, hand in enumerate(joints_m[frame]):
            if not np.isfinite(hand).all():
                continue
            joints = transform(invert(world_from_camera), hand)
            palm = joints[PALM[kind]]
            arm = _arm(palm, number, shape)
            canvas[:] = 0
            for start, end in bones:
                radius_m = shape.finger_radius_m
                draw_capsule(canvas, joints[start], joints[end], radius_m, cameras, shape)
            for start, end in pairwise(arm):
                draw_capsule(canvas, start, end, shape.arm_radius_m, cameras, shape)
            if (palm[:, 2] > shape.near_m).all():
                u, v = project(cameras.intrinsics_px, palm)
                corners = np.rint(np.stack([u, v], axis=1)).astype(np.int32)
                cv2.fillConvexPoly(canvas, cv2.convexHull(corners), 1)
            covered[frame][canvas > 0] = number
    return covered


def _arm(palm: Float[np.ndarray, "k 3"], number: int, shape: HandShape) -> list[Vector]:
    """Return the points of an arm in camera axes: wrist, elbow if it has one, and its end."""
    arm = [palm[0]]
    sides = shape.sides_m
    across = palm[0, 0] if sides is None else sides[number]
    origin = np.array(shape.shoulder_offset_m) + [across, 0, 0]
    if shape.forearm_m is not None:
        along = _unit(palm[0] - palm[1:].mean(axis=0)) + shape.bend * _unit(origin - palm[0])
        arm.append(palm[0] + shape.forearm_m * _unit(along))
    return [*arm, arm[-1] + shape.arm_fraction * (origin - arm[-1])]


def _unit(vector: Vector) -> Vector:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def draw_capsule(
    canvas: UInt8[np.ndarray, "h w"],
    start: Vector,
    end: Vector,
    radius_m: float,
    cameras: Cameras,
    shape: HandShape,
) -> None:
    """Draw a capsule between two points in camera coordinates, as a row of discs."""
    import cv2

    centers_m = start + np.linspace(0, 1, shape.discs)[:, None] * (end - start)
    centers_m = centers_m[centers_m[:, 2] > shape.near_m]
    limit = 10 * cameras.width  # outside the image, but within the range of OpenCV's integers
    centers = np.clip(np.stack(project(cameras.intrinsics_px, centers_m), axis=1), -limit, limit)
    radii = cameras.intrinsics_px[0, 0] * radius_m / centers_m[:, 2]
    for (column, row), radius in zip(np.rint(centers).astype(int), radii, strict=True):
        cv2.circle(canvas, (int(column), int(row)), max(1, round(float(radius))), 1, -1)
