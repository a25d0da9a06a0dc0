"""Pushes: a body, a drawer or a lid moves out of the flesh of a hand that does not reach around it.

A pushed body translates and turns by the friction under its footprint. The limit surface is an
ellipsoid: a force f at r from the center gives the velocity v = f, w = (r x f) / c^2, with c the
radius of gyration of the pressure (Goyal, Ruina and Papadopoulos 1991).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.geometry import invert, rotation_z
from egosim_jax.types import Kind
from egosim_jax.worlds.tabletop.bodies import Body
from egosim_jax.worlds.tabletop.hands import fingers_of
from egosim_jax.worlds.tabletop.scene import Scene, moving_part
from egosim_jax.worlds.tabletop.solids import surface_of
from egosim_jax.worlds.tabletop.support import min_opening, move

FITS = 0.85
"""Minimum opening of a hand that reaches around a body, as a fraction of the body's grip."""
DESCENT = 0.15
"""Descent per horizontal motion from which an open hand comes down on a body."""
STEEP = 0.7
"""Vertical component of a normal above which a hand presses instead of pushing."""
GYRATION = 0.6
"""Radius c of the limit surface, as a fraction of half a body's width."""
MAX_PUSHES = 8
"""Maximum number of pushes of one body in one step: two fingers may squeeze it."""
SURFACE_M = 1e-6
"""Depth in the flesh that counts as out of it, in meters."""


def yields(
    body: Body,
    way_m: Float[np.ndarray, "p 3"],
    opening_m: Float[np.ndarray, " 3"],
    normals: Float[np.ndarray, "2 3"],
    kind: Kind,
    closing: bool,
) -> Bool[np.ndarray, " p"]:
    """Return which touching points of a hand yield to a body, because the hand reaches around it.

    The body must fit in the opening between the grasping tips. All points yield that come down on
    it (`way_m` in one step). Fingers that close on it yield while it is between the tips: its
    surface faces both (`normals`).
    """
    if np.linalg.norm(opening_m) < FITS * body.grip_m:
        return np.zeros(len(way_m), bool)
    falling = -way_m[:, 2] > DESCENT * np.linalg.norm(way_m[:, :2], axis=1)
    between = normals[0] @ opening_m < 0 < normals[1] @ opening_m
    return falling | fingers_of(kind) if closing and between else falling


def push_out(
    scene: Scene, name: str, points_m: Float[np.ndarray, "n 3"], flesh_m: float
) -> tuple[Scene, Bool[np.ndarray, " n"]]:
    """Move a body or its moving part out of the flesh around points, the deepest one first.

    Also returns which points press instead: they are above or below it, or on a part that does not
    move. A push may turn a body under the next point, so that this is decided before each push.
    """
    pressing = np.zeros(len(points_m), bool)
    if not len(points_m):
        return scene, pressing
    for _ in range(MAX_PUSHES):
        distance, normal, moving = surface_of(scene, scene.body(name), points_m)
        pressing |= (distance < flesh_m) & ((np.abs(normal[:, 2]) > STEEP) | ~moving)
        distance[pressing] = np.inf
        deepest = int(distance.argmin())
        depth = flesh_m - float(distance[deepest])
        if depth <= SURFACE_M:
            break
        pushed = _push(scene, name, points_m[deepest], normal[deepest], depth)
        if pushed is scene:  # a drawer or a lid at its stop
            break
        scene = pushed
    return scene, pressing


def _push(
    scene: Scene,
    name: str,
    point_m: Float[np.ndarray, " 3"],
    normal: Float[np.ndarray, " 3"],
    depth_m: float,
) -> Scene:
    """Move a body by the depth of a point in it; the normal there must not be vertical."""
    body = scene.body(name)
    if body.articulated:  # one Newton step, by a numerical derivative of the distance
        step, now = 1e-3, scene.openings[name]
        local = invert(scene.first_part_pose(name)) @ [*point_m, 1.0]
        ahead = moving_part(body, now + step) @ local
        speed = float(normal @ ((body.world_from_body @ ahead)[:3] - point_m)) / step
        if abs(speed) < 1e-3:
            return scene
        opening = float(np.clip(now - depth_m / speed, min_opening(scene, body), 1))
        return scene if opening == now else scene.with_opening(name, opening)
    slope = float(np.linalg.norm(normal[:2]))
    force, depth = -normal * [1, 1, 0] / slope, depth_m / slope
    center = body.world_from_body[:3, 3]
    lever = point_m - center
    torque = float(lever[0] * force[1] - lever[1] * force[0])
    square = (GYRATION * body.size_m[0] / 2) ** 2
    amount = depth / (1 + torque**2 / square)
    motion = np.eye(4)
    motion[:3, :3] = rotation_z(amount * torque / square)
    motion[:3, 3] = center + amount * force - motion[:3, :3] @ center
    return move(scene, name, motion @ body.world_from_body)
