"""Checks of a described robot's model: what its gripper does, its sizes and its equalities."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.bounded import listing, own_file, quote, quote_path
from egosim_jax.robots.description import Description
from egosim_jax.robots.models import TABLE, RobotModel, grip_of, limits_of
from egosim_jax.types import InputError

REACH_M = (0.1, 4.0)
"""Least and largest distance of the gripper from the base, over all postures."""
WORKING = 0.65
"""Share of the largest distance up to which the gripper works in most directions."""
SAMPLES = 300
"""Number of random postures that are tried."""
OPENING_TOLERANCE, OPENING_TOLERANCE_M = 0.1, 0.002
"""Largest difference of the opening from the described one: a share of it, or meters."""
MIN_OPENING_M = 1e-4
"""Distance below which the fingers do not move."""
KEPT = 1e-3
"""Largest violation of an equality, in meters or radians."""
FOLLOWS = 1e-6
"""Least motion of a joint that follows, in meters or radians."""
MAX_CHAIN_M = 8.0
"""Largest length of all links from base to gripper."""
WIDE_M = 1.0
"""Size of a geometry that any robot may have, also a small one."""
UNITS = "Models are in meters: scale an export in millimeters by 0.001. (model)"


def compile_mjcf(spec: Any, path: Path) -> None:
    """Compile an MJCF; MuJoCo names only the first file that is missing, `InputError` all."""
    try:
        spec.compile()
    except ValueError:
        _check_assets(spec, path)
        raise


def _check_assets(spec: Any, path: Path) -> None:
    """Raise `InputError` with the names of the meshes and textures of an MJCF that are missing."""
    files = [(spec.compiler.meshdir, asset.file) for asset in [*spec.meshes, *spec.hfields]]
    files += [(spec.compiler.texturedir, asset.file) for asset in spec.textures]
    named = [f"{folder}/{file}" if folder else file for folder, file in files if file]
    missing = [file for file in dict.fromkeys(named) if own_file(path.parent, file) is None]
    if missing:
        raise InputError(
            f"{quote_path(path)} names {len(missing)} files that are missing: "
            f"{listing([quote(file) for file in missing])}. Restore them."
        )


def check_closing(described: Description, opened: np.ndarray, closed: np.ndarray) -> None:
    """Raise `InputError` unless the tips, given at both ends of the driving joint, close."""
    name, gripper = quote_path(described.path), described.gripper
    driver, sign = gripper.joints[0], gripper.closing_sign
    wide, narrow = (float(np.linalg.norm(tips[1] - tips[0])) for tips in (opened, closed))
    if abs(wide - narrow) < MIN_OPENING_M:
        raise InputError(
            f"{name}: the tips do not move apart with the joint {quote(driver)}: name the joint "
            "that drives first, and tips on the fingers. (gripper.joints, gripper.tips)"
        )
    if wide < narrow:
        raise InputError(
            f"{name}: the gripper opens by {1000 * (narrow - wide):.1f} mm when it should "
            f"close, by {quote(driver)}: closing_sign must be {-sign}. (gripper.closing_sign)"
        )


def check_gripper(described: Description, robot: RobotModel) -> None:
    """Raise `InputError` unless the gripper does what its description says."""
    name, gripper = quote_path(described.path), described.gripper
    driver, openings = gripper.joints[0], robot.openings_m
    ends = robot.arm.gripper
    driven = robot.positions[:, _column(robot, driver)]
    path = np.diff(driven)
    if openings[0] < -MIN_OPENING_M or path.min() < 0 < path.max():
        raise InputError(
            f"{name}: the tips pass each other or turn back while {quote(driver)} goes from "
            f"{ends.open:g} to {ends.closed:g}; they are nearest at {driven[0]:.4g} and farthest "
            f"apart at {driven[-1]:.4g}, across the fingers. Correct the tips' offsets, or give "
            "the positions of both ends. (gripper.tips, gripper.closed_at, gripper.open_at)"
        )
    moved = np.ptp(robot.positions, axis=0)
    still = [j for j in gripper.joints[1:] if moved[_column(robot, j)] < FOLLOWS]
    if still:
        raise InputError(
            f"{name}: {listing([quote(joint) for joint in still])} does not follow "
            f"{quote(driver)}: add <mimic> to it in the URDF, or an <equality> of both joints to "
            "the MJCF. (gripper.joints)"
        )
    measured, said = robot.largest_m, gripper.largest_opening_m
    if abs(measured - said) > max(OPENING_TOLERANCE * said, OPENING_TOLERANCE_M):
        raise InputError(
            f"{name}: the tips of the model open by {1000 * measured:.4g} mm, and "
            f"largest_opening_m is {said:g}, {1000 * said:.4g} mm: they may differ by "
            f"{OPENING_TOLERANCE:.0%}. Correct the tips, the limits of {quote(driver)}, or "
            "the number. (gripper.largest_opening_m)"
        )


def check_length(described: Description, length_m: float) -> None:
    """Raise `InputError` for links that are too long together for a robot in meters."""
    if length_m > MAX_CHAIN_M:
        raise InputError(
            f"{quote_path(described.path)}: the links from base to gripper are {length_m:.4g} m "
            f"long together: at most {MAX_CHAIN_M:g} m is a robot's. {UNITS}"
        )


def with_reach(described: Description, robot: RobotModel) -> RobotModel:
    """Return the model with its reach, from random postures. Raises `InputError` for its size."""
    places = [
        float(np.linalg.norm(grip_of(robot, data)[:3, 3]))
        for data in _random_postures(robot, SAMPLES)
    ]
    low, high = REACH_M
    if not low <= (reach := max(places)) <= high:
        raise InputError(
            f"{quote_path(described.path)}: the gripper is up to {reach:.4g} m from the base: it "
            f"must be from {low:g} to {high:g} m. {UNITS}"
        )
    return replace(robot, arm=replace(robot.arm, reach_m=WORKING * reach))


def check_sizes(described: Description, robot: RobotModel) -> None:
    """Raise `InputError` for geometries that are much larger or smaller than the arm, or absent."""
    mj, name = robot.mj, quote_path(described.path)
    reach = robot.arm.reach_m / WORKING
    parts = [n for n in range(mj.ngeom) if n != mj.geom(TABLE).id and mj.geom_rbound[n] > 0]
    if not parts:
        raise InputError(
            f"The model of {name} has no geometry, so nothing of the robot could be drawn or "
            "removed: add <visual> or <collision>. (model)"
        )
    largest = max(parts, key=lambda n: mj.geom_rbound[n])
    size = float(mj.geom_rbound[largest])
    if size > max(2 * reach, WIDE_M) or size < reach / 300:
        body = mj.body(mj.geom_bodyid[largest]).name
        raise InputError(
            f"{name}: the largest geometry of the model, of {quote(body)}, has a radius of "
            f"{size:.4g} m, and the arm reaches {reach:.3g} m: its unit is not the meter. Give "
            'the mesh scale="0.001 0.001 0.001" if it is in millimeters. (model)'
        )


def check_equalities(described: Description, robot: RobotModel) -> None:
    """Raise `InputError` unless the model's equalities hold in all postures."""
    mujoco: Any = import_module("mujoco")

    mj = robot.mj
    for data in _random_postures(robot, 16):
        mujoco.mj_fwdPosition(mj, data)
        worst = int(np.abs(data.efc_pos[: data.ne]).argmax()) if data.ne else 0
        if data.ne and abs(data.efc_pos[worst]) > KEPT:
            number = int(data.efc_id[worst])
            label = mj.equality(number).name or f"equality {number}"
            raise InputError(
                f"{quote_path(described.path)}: {quote(label)} of the model does not hold when the "
                f"arm or its gripper moves (off by {abs(float(data.efc_pos[worst])):.3g}): joints "
                "of an arm must be free of <mimic> and <equality>, and a gripper's equalities must "
                "be met from open to closed. (model)"
            )


def _random_postures(robot: RobotModel, count: int) -> Iterator[Any]:
    """Yield the model's data in postures within the limits, with openings from closed to open."""
    mujoco: Any = import_module("mujoco")

    generator, mj = np.random.default_rng(0), robot.mj
    low, high = np.array(
        [limits_of(mj, name) or (-np.pi, np.pi) for name in robot.arm.joints], float
    ).T
    data = mujoco.MjData(mj)
    for n in range(count):
        q = robot.home
        q[robot.joint_at] = generator.uniform(low, high)
        data.qpos[:] = robot.open(q, robot.largest_m * n / max(count - 1, 1))
        mujoco.mj_kinematics(mj, data)
        yield data


def _column(robot: RobotModel, joint: str) -> int:
    """Return the column of a gripper's joint in the table of its positions."""
    place = int(robot.mj.joint(joint).qposadr[0])
    return robot.gripper_at.tolist().index(place)
