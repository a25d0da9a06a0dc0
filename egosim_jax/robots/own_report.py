"""Text of `egosim robot check`: the parts of a described robot."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from egosim_jax.io.bounded import listing, quote_path
from egosim_jax.robots.checks import WORKING
from egosim_jax.robots.ik import posed
from egosim_jax.robots.models import RobotModel, is_slide, limits_of, tip_point
from egosim_jax.robots.own import OwnModel
from egosim_jax.runtime.terminal import printable


def lines_of(own: OwnModel) -> Iterator[str]:
    """Yield what a checked robot has, line by line."""
    for line in _lines(own):
        yield printable(line)


def _lines(own: OwnModel) -> Iterator[str]:
    described, robot = own.description, own.robot
    arm, gripper, mj = robot.arm, robot.arm.gripper, robot.mj
    yield f"{quote_path(described.path)}: {arm.title}, {quote_path(described.model)}"
    count = len(arm.joints)
    yield f"base {described.base}, {count} joints, up to {arm.reach_m / WORKING:.2f} m to the grip"
    for name, home, speed in zip(arm.joints, arm.home, arm.speeds, strict=True):
        rest = f"home {round(home, 3) + 0.0:g}, {speed:.3g}/s"
        yield f"  {name}: {_kind(mj, name)}, {_limits(mj, name)}, {rest}"
    for name, value in described.fixed.items():
        yield f"  {name}: {_kind(mj, name)} that rests at {value:g}"
    yield (
        f"gripper on {gripper.body}, fingers along "
        f"({', '.join(f'{value:.2f}' for value in gripper.approach)}) of it"
    )
    yield (
        f"  {gripper.driver}: {_kind(mj, gripper.driver)}, open at {gripper.open:g}, closed at "
        f"{gripper.closed:g}"
    )
    for name in described.gripper.joints[1:]:
        yield f"  {name}: {_kind(mj, name)}, follows"
    for tip, (body, point) in zip(described.gripper.tips, gripper.tips, strict=True):
        at = ", ".join(f"{1000 * value:.1f}" for value in point)
        yield f"  tip {tip.frame}: ({at}) mm of {body}"
    yield (
        f"  opens by {1000 * robot.largest_m:.1f} mm (largest_opening_m: "
        f"{1000 * described.gripper.largest_opening_m:.1f} mm); closed, the tips are "
        f"{1000 * _rest_m(robot):.1f} mm apart"
    )
    meshes = f", {mj.nmesh} meshes" if mj.nmesh else ""
    yield f"{mj.ngeom - 1} geometries{meshes}, {mj.neq} equalities"
    if own.replaced:
        yield (
            f"drawn by their collision geometry, because MuJoCo does not read their visual meshes: "
            f"{listing(list(own.replaced))}"
        )
    if described.camera is not None:
        place = described.camera.base_from_camera[:3, 3]
        at = ", ".join(f"{value:.3f}" for value in place)
        size = f"{described.camera.width}x{described.camera.height}"
        yield f"camera of {size} at ({at}) m of the base"
    if described.recording is not None:
        names = ", ".join(described.recording.names or described.joints)
        yield f"recordings in {described.recording.angle_unit}: {names}"


def _rest_m(robot: RobotModel) -> float:
    """Return the distance of the tips of the closed gripper."""
    data = posed(robot, robot.open(robot.home, 0.0))
    first, second = (tip_point(data.body(body), point) for body, point in robot.arm.gripper.tips)
    return float(np.linalg.norm(first - second))


def _kind(mj: Any, name: str) -> str:
    return "slide" if is_slide(mj, name) else "hinge"


def _limits(mj: Any, name: str) -> str:
    if (limits := limits_of(mj, name)) is None:
        return "endless"
    low, high = limits
    if is_slide(mj, name):
        return f"{1000 * low:.0f} to {1000 * high:.0f} mm"
    return f"{np.degrees(low):.0f} to {np.degrees(high):.0f} degrees"
