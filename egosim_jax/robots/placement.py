"""Placement of a robot's base, so that it reaches a path of grips without hiding the view."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from itertools import product
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.geometry import invert, pixel_rays, rotation_z, transform
from egosim_jax.robots.ik import REACHED_M, Solver, Track, posed
from egosim_jax.robots.models import TABLE, RobotModel, grip_of
from egosim_jax.robots.retarget import Grips
from egosim_jax.types import Cameras

ANGLES = np.radians([0, 30, -30, 60, -60, 90, -90, 135, -135, 180])
"""Directions of the base as seen from the path, from the wearer's, in order of preference."""
DISTANCES = (0.65, 0.8, 0.5, 0.35)
"""Distances of the base from the middle of the path, in reaches of the arm."""
Base = tuple[float, float, float, float]
"""Place in meters and yaw in degrees, in a frame on the table, z upwards."""
MOMENTS = 6
"""Number of frames of the path that decide where a base is tried."""
FIRST_STEPS, NEXT_STEPS = 40, 12
"""Steps of the search for the first and for each further moment."""
GOOD_TURN = np.radians(15)
"""Direction error up to which a base is taken at once."""
EYE_M = 0.12
"""Least distance of the arm's links in front of the camera from it."""
FAR_M = 10.0
"""Distance from the camera within which an arm covers the image."""
WRIST_M = 0.1
"""Distance from the gripper's wrist within which a link does not hide it."""
COVER, COVER_COST = 0.2, 3.0
"""Share of the image that an arm may cover, and cost of the rest, in radians of direction error."""
VIEW = 9, 7
"""Numbers of columns and rows of the image at which it is tested what the arm covers."""
BAD = 10.0
"""Cost of a moment that is not reached or not seen, in radians of direction error."""
MAX_TRACKS, ENOUGH = 4, 0.99
"""Maximum number of bases whose whole path is tried, and share of it that ends the search."""
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Half turn of a grip about its approach: the two fingers change places."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Placed:
    """A base and the motion of its arm along the path."""

    world_from_base: Float[np.ndarray, "4 4"]
    """Pose of the base."""
    track: Track
    """Motion in the base frame."""
    clear: Bool[np.ndarray, " f"]
    """Mask of the frames in which no link is close in front of the camera."""


def place(
    robot: RobotModel,
    grips: Grips,
    *,
    world_from_up: Float[np.ndarray, "4 4"],
    cameras: Cameras,
    fps: int | float,
    base: Base | None = None,
) -> Placed:
    """Return the base from which the arm reaches most of the path, clear of the camera.

    `cameras` has a camera for each grip. `world_from_up` is a frame on the table, z upwards. By
    default, `base` is searched.
    """
    up_from_grip = invert(world_from_up) @ grips.world_from_grip
    view = _view(cameras)
    eyes = invert(world_from_up) @ cameras.world_from_camera
    moments = np.unique(np.linspace(0, len(eyes) - 1, MOMENTS).astype(int))
    facing = _facing(robot)
    bases = (
        [_base(base[:3], np.radians(base[3]))]
        if base
        else _candidates(robot, up_from_grip[:, :3, 3], eyes[:, :3, 3], facing)
    )
    tried = []
    for up_from_base in bases:
        solver = Solver(robot, table_m=-up_from_base[2, 3])
        for flip in (np.eye(4), FLIP):
            path = invert(up_from_base) @ up_from_grip @ flip
            local = invert(up_from_base) @ eyes
            openings = grips.opening_m[moments]
            cost, start = _try(solver, path[moments], openings, local[moments], view)
            tried.append((cost, len(tried), up_from_base, path, start))
        if min(t[0] for t in tried[-2:]) < GOOD_TURN:
            break
    tried.sort(key=lambda t: t[:2])
    found: list[Placed] = []
    for _, _, up_from_base, path, start in tried[:MAX_TRACKS]:
        solver = Solver(robot, table_m=-up_from_base[2, 3])
        track = solver.follow(start, path, grips.opening_m, fps=fps)
        clear = _clear(solver, track, invert(up_from_base) @ eyes)
        found.append(Placed(world_from_base=world_from_up @ up_from_base, track=track, clear=clear))
        if track.reached[grips.seen].mean() >= ENOUGH and clear.mean() >= ENOUGH:
            break
    return max(
        found, key=lambda placed: placed.track.reached[grips.seen].mean() + placed.clear.mean()
    )


def _clear(solver: Solver, track: Track, cameras: np.ndarray) -> Bool[np.ndarray, " f"]:
    """Return in which frames no link is within `EYE_M` of the camera, in nine directions ahead."""
    rays = np.array([(*across, 1.0) for across in product((-1.0, 0.0, 1.0), repeat=2)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    clear = []
    for q, opening, camera in zip(track.q, track.opening_m, cameras, strict=True):
        data = posed(solver.robot, solver.robot.open(q, float(opening)))
        clear.append(not _meets(solver, data, camera, rays, EYE_M).any())
    return np.array(clear)


def _try(
    solver: Solver, path: np.ndarray, openings: np.ndarray, cameras: np.ndarray, view: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the cost of a base, and the posture at the first moment.

    The cost is the mean direction error in radians, more for an arm that covers much of the image,
    and `BAD` for each moment that is not reached, and for each in which the arm is close in front
    of the camera or hides the gripper from it.
    """
    robot = solver.robot
    q = start = robot.home
    cost = 0.0
    for number, (pose, opening, camera) in enumerate(zip(path, openings, cameras, strict=True)):
        opening = float(np.clip(opening, robot.openings_m[0], robot.openings_m[-1]))
        q = solver.approach(q, pose, opening, steps=NEXT_STEPS if number else FIRST_STEPS)
        start = q if number == 0 else start
        data = posed(robot, robot.open(q, opening))
        grip = grip_of(robot, data)
        miss = bool(np.linalg.norm(grip[:3, 3] - pose[:3, 3]) > REACHED_M)
        turn = np.arccos(np.clip((np.sum(grip[:3, :3] * pose[:3, :3]) - 1) / 2, -1, 1))
        links = transform(invert(camera), data.xpos[1:])
        near = bool(((links[:, 2] > 0) & (np.linalg.norm(links, axis=1) < EYE_M)).any())
        cost += float(turn) + BAD * (miss + (near or _hides(solver, data, camera[:3, 3])))
        cost += COVER_COST * max(0.0, _covered(solver, data, camera, view) - COVER)
    return cost / len(path), start


def _view(cameras: Cameras) -> Float[np.ndarray, "n 3"]:
    """Return directions through a grid of the image, of length 1, in camera axes."""
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    columns, rows = (
        ((np.arange(count) + 0.5) * size / count).astype(int)
        for count, size in zip(VIEW, (cameras.width, cameras.height), strict=True)
    )
    some = rays[rows][:, columns].reshape(-1, 3)
    return some / np.linalg.norm(some, axis=1, keepdims=True)


def _covered(solver: Solver, data: Any, camera: np.ndarray, view: np.ndarray) -> float:
    """Return the share of the image's directions in which the arm is."""
    return float(_meets(solver, data, camera, view, FAR_M).mean())


def _meets(
    solver: Solver, data: Any, camera: np.ndarray, rays: np.ndarray, within_m: float
) -> Bool[np.ndarray, " n"]:
    """Return which directions from the camera, in its axes, meet the arm within a distance."""
    mujoco: Any = import_module("mujoco")

    mj, toward = solver.robot.mj, (rays @ camera[:3, :3].T).ravel()
    hits, distances = np.zeros(len(rays), np.int32), np.zeros(len(rays))
    mujoco.mj_multiRay(
        mj, data, camera[:3, 3], toward, None, True, -1, hits, distances, None, len(rays), within_m
    )
    return (hits >= 0) & (hits != mj.geom(TABLE).id) & (distances < within_m)


def _hides(solver: Solver, data: Any, eye: np.ndarray) -> bool:
    """Return whether a link is between the camera and the gripper's wrist."""
    mujoco: Any = import_module("mujoco")

    mj = solver.robot.mj
    ray = data.xpos[mj.site_bodyid[solver.robot.site]] - eye
    length = float(np.linalg.norm(ray))
    hit = np.zeros(1, np.int32)
    distance = mujoco.mj_ray(mj, data, eye, ray / length, None, True, -1, hit)
    return 0 <= float(distance) < length - WRIST_M


def _candidates(
    robot: RobotModel, points: np.ndarray, eyes: np.ndarray, facing: float
) -> list[np.ndarray]:
    """Return poses of the base on the table, the best first: on the wearer's side."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    behind = eyes.mean(axis=0) - middle
    toward = np.arctan2(behind[1], behind[0])
    found = []
    for angle in ANGLES:
        for share in DISTANCES:
            where = toward + angle
            distance = share * robot.arm.reach_m
            x, y = middle[:2] + distance * np.array([np.cos(where), np.sin(where)])
            found.append(_base((x, y, 0.0), where + np.pi - facing))
    return found


def _facing(robot: RobotModel) -> float:
    """Return the direction of the gripper at home, as an angle about z."""
    x, y, _ = grip_of(robot, posed(robot, robot.home))[:3, 3]
    return float(np.arctan2(y, x))


def _base(place: tuple[float, float, float], yaw: float) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_z(yaw), place
    return pose
