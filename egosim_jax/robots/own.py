"""Described robots: loading and checking the model of a description (`description.py`).

A check compares what the description says with what the model does: every joint has a role and
limits, the gripper closes in the described direction and opens as wide as described, its joints
follow the one that drives, nothing else follows the arm, and sizes are of a robot in meters.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.geometry import invert, transform
from egosim_jax.io.bounded import listing, quote, quote_path, refusing
from egosim_jax.io.untrusted.isolated import read_file
from egosim_jax.io.untrusted.mjcf import check_files
from egosim_jax.io.untrusted.xml_tree import parse_xml
from egosim_jax.robots import arms, models
from egosim_jax.robots.arms import Arm, Gripper, Point
from egosim_jax.robots.checks import (
    check_closing,
    check_equalities,
    check_gripper,
    check_length,
    check_sizes,
    compile_mjcf,
    with_reach,
)
from egosim_jax.robots.description import SUFFIX, Description, read_description
from egosim_jax.robots.models import (
    MAX_CPU_S,
    MAX_MEMORY,
    RobotModel,
    check_installed,
    close_loops,
    limits_of,
    make_model,
    pose_of,
    tip_point,
)
from egosim_jax.robots.toml import nearest
from egosim_jax.robots.urdf import Urdf, read_urdf
from egosim_jax.types import InputError

MIN_APPROACH_M = 0.01
"""Least distance of the closed tips from their body's origin that gives a direction."""
FIX = "correct the model or the description. (egosim robot check)"


@dataclass(frozen=True, kw_only=True)
class OwnModel:
    """Checked model of a described robot."""

    description: Description
    """Description of the robot."""
    robot: RobotModel
    """Its model."""
    replaced: tuple[str, ...] = ()
    """Links that are drawn by their collision geometry, because MuJoCo cannot read the visual."""


def open_robot(name: str) -> RobotModel:
    """Return the model of an arm of the table by name, or of a description by its file."""
    if is_description(name):
        return load_own(Path(name)).robot
    return models.load_model(arms.arm_of(name))


def is_description(name: str) -> bool:
    """Return True for the file of a description rather than the name of an arm."""
    return name.endswith(SUFFIX)


def load_own(path: Path) -> OwnModel:
    """Return the checked model of a description. Raises `InputError` for the first problem."""
    check_installed()
    described = read_description(path)
    if not described.model.is_file():
        raise InputError(
            f"{quote_path(described.model)} is missing: {quote_path(path)} names it. It must be a "
            "URDF or an MJCF, relative to the description. (model)"
        )
    return read_file(_load, described.model, described, max_memory=MAX_MEMORY, max_cpu_s=MAX_CPU_S)


def _load(path: Path, described: Description) -> OwnModel:
    """Return the model of a description; this runs in a child process."""
    mujoco: Any = import_module("mujoco")

    root, name = parse_xml(path), quote_path(path)
    with warnings.catch_warnings(), refusing(f"{name} is not a valid model"):
        warnings.filterwarnings("ignore", message="Attaching a spec with an empty prefix")
        if root.tag == "robot":
            urdf = read_urdf(path, root, described.packages, described.path.parent)
        elif root.tag == "mujoco":
            check_files(path.parent)
            urdf = Urdf(spec=mujoco.MjSpec.from_file(str(path)))
            compile_mjcf(urdf.spec, path)
        else:
            raise InputError(
                f"{name} begins with <{quote(root.tag)[1:-1]}>: it must be a URDF (<robot>) or an "
                "MJCF (<mujoco>). Expand a xacro first."
            )
        return _checked(described, urdf)


def _checked(described: Description, urdf: Urdf) -> OwnModel:
    """Return the model of a specification after all checks."""
    spec = urdf.spec
    for key in list(spec.keys):
        spec.delete(key)
    _check_names(described, spec)
    _apply_limits(described, spec)
    _check_limits(described, urdf, spec.compile())
    spec = _rooted(described, spec)
    mj = spec.compile()
    _check_chain(described, mj)
    arm = _arm(described, urdf, mj)
    robot = make_model(arm, spec, fix=FIX)
    check_gripper(described, robot)
    robot = with_reach(described, robot)
    check_sizes(described, robot)
    check_equalities(described, robot)
    return OwnModel(description=described, robot=robot, replaced=tuple(urdf.replaced))


def _check_names(described: Description, spec: Any) -> None:
    """Raise `InputError` for a joint or frame that the model does not have, and a free joint."""
    name, gripper = quote_path(described.path), described.gripper
    joints = [joint.name for joint in spec.joints]
    roles = {
        "joints": described.joints,
        "gripper.joints": gripper.joints,
        "fixed": tuple(described.fixed),
        "limits": tuple(described.limits),
    }
    for key, listed in roles.items():
        for joint in listed:
            if joint not in joints:
                raise InputError(
                    f"{name} names the joint {quote(joint)}, which the model does not have or that "
                    f"is fixed there. ({key}){nearest(joint, joints)}"
                )
    free = [
        j for j in joints if all(j not in roles[k] for k in ("joints", "gripper.joints", "fixed"))
    ]
    if free:
        raise InputError(
            f"{name} does not say what {len(free)} joints of the model do: "
            f"{listing([quote(joint) for joint in free])}. Add them to joints or gripper.joints, "
            "or give the position at which they rest, such as torso = 0.0. (fixed)"
        )
    bodies = [body.name for body in spec.bodies]
    frames = [*bodies, *(site.name for site in spec.sites)]
    for key, frame in [
        ("base", described.base),
        *(("gripper.tips", t.frame) for t in gripper.tips),
    ]:
        if frame not in frames:
            raise InputError(
                f"{name} names the frame {quote(frame)}: the model has no such link, body or site. "
                f"({key}){nearest(frame, frames)}"
            )
    if gripper.body is not None and gripper.body not in bodies:
        raise InputError(
            f"{name} names the body {quote(gripper.body)}, which the model does not have. "
            f"(gripper.body){nearest(gripper.body, bodies)}"
        )


def _apply_limits(described: Description, spec: Any) -> None:
    """Set the described limits, and equalities of the joints that rest."""
    mujoco: Any = import_module("mujoco")

    mj = spec.compile()
    for name, limits in described.limits.items():
        joint = spec.joint(name)
        if (known := limits_of(mj, name)) is not None:
            raise InputError(
                f"{quote_path(described.path)} gives limits of {quote(name)}, and the model has "
                f"{_interval(known)}: keep one of them. (limits)"
            )
        hinge = joint.type == mujoco.mjtJoint.mjJNT_HINGE
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.range = np.degrees(limits) if hinge and spec.compiler.degree else limits
    for name, value in described.fixed.items():
        if mujoco.mjtJoint(int(mj.jnt_type[mj.joint(name).id])) not in (
            mujoco.mjtJoint.mjJNT_HINGE,
            mujoco.mjtJoint.mjJNT_SLIDE,
        ):
            raise InputError(
                f"{quote_path(described.path)} fixes {quote(name)}, which is no hinge or "
                "slide: remove it from the model. (fixed)"
            )
        rest = float(mj.qpos0[mj.joint(name).qposadr[0]])
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=name,
            data=[value - rest, *[0.0] * (mujoco.mjNEQDATA - 1)],
        )


def _check_limits(described: Description, urdf: Urdf, mj: Any) -> None:
    """Raise `InputError` for joints without limits or without speed, and a home outside of them."""
    name = quote_path(described.path)
    driver = described.gripper.joints[0]
    endless = [
        joint
        for joint in (*described.joints, driver)
        if limits_of(mj, joint) is None and (joint == driver or joint not in urdf.continuous)
    ]
    if endless:
        raise InputError(
            f"The model of {name} has no limits of {listing([quote(joint) for joint in endless])}: "
            "a robot would be drawn where it cannot be. Add them to the model, or here, such as "
            f"{endless[0][:40]} = [-3.14, 3.14]. (limits)"
        )
    slow = [j for j in described.joints if j not in urdf.speeds]
    if slow and not described.speeds:
        raise InputError(
            f"The model of {name} has no speed of {listing([quote(joint) for joint in slow])}: "
            "give the maximum speed of every joint in rad/s, or m/s of a slide. (speeds)"
        )
    for joint, value in zip(described.joints, described.home, strict=False):
        limits = limits_of(mj, joint)
        if limits is not None and not limits[0] <= value <= limits[1]:
            raise InputError(
                f"{name}: home has {value:g} for {quote(joint)}, whose limits are "
                f"{_interval(limits)}: it must be inside, in radians or meters. (home)"
            )


def _rooted(described: Description, spec: Any) -> Any:
    """Return the specification with the base's frame at the origin."""
    mujoco: Any = import_module("mujoco")

    mj = spec.compile()
    data = _resting(described, mj)
    frame = _frame(mj, data, described.base)
    body = _body(mj, described.base)
    while body:
        names = [mj.joint(mj.body_jntadr[body] + n).name for n in range(mj.body_jntnum[body])]
        if moving := [joint for joint in names if joint not in described.fixed]:
            raise InputError(
                f"{quote_path(described.path)}: the base {quote(described.base)} moves with the "
                f"joint {quote(moving[0])}: it must be a frame before the first joint. (base)"
            )
        body = int(mj.body_parentid[body])
    if np.allclose(frame, np.eye(4), atol=1e-12):
        return spec
    pose, turn = invert(frame), np.zeros(4)
    mujoco.mju_mat2Quat(turn, pose[:3, :3].ravel())
    around = mujoco.MjSpec()
    at = around.worldbody.add_frame(pos=pose[:3, 3], quat=turn)
    around.attach(spec, frame=at, prefix="")
    return around


def _check_chain(described: Description, mj: Any) -> None:
    """Raise `InputError` unless the arm's joints, in order, carry the gripper."""
    body, chain, length_m = _palm(described, mj), [], 0.0
    while body:
        length_m += float(np.linalg.norm(mj.body_pos[body]))
        names = [mj.joint(mj.body_jntadr[body] + n).name for n in range(mj.body_jntnum[body])]
        chain = [*names, *chain]
        body = int(mj.body_parentid[body])
    carrying = tuple(joint for joint in chain if joint not in described.fixed)
    if carrying != described.joints:
        raise InputError(
            f"{quote_path(described.path)} has the joints {', '.join(described.joints)[:200]}, and "
            f"the gripper hangs on {', '.join(carrying)[:200] or 'none'}: they must be the same, "
            "from base to wrist. (joints, gripper.body)"
        )
    check_length(described, length_m)


def _arm(described: Description, urdf: Urdf, mj: Any) -> Arm:
    """Return the arm of a description, with what the model completes; its reach is unknown."""
    gripper, palm = described.gripper, _palm(described, mj)
    low, high = mj.joint(gripper.joints[0]).range.tolist()
    opened, closed = (low, high) if gripper.closing_sign > 0 else (high, low)
    for key in ("open_at", "closed_at"):
        value = getattr(gripper, key)
        if value is not None and not low <= value <= high:
            raise InputError(
                f"{quote_path(described.path)}: {key} is {value:g}, and the limits of "
                f"{quote(gripper.joints[0])} are {_interval((low, high))}: it must be inside, in "
                f"radians or meters. (gripper.{key})"
            )
    opened = opened if gripper.open_at is None else gripper.open_at
    closed = closed if gripper.closed_at is None else gripper.closed_at
    if (closed - opened) * gripper.closing_sign <= 0:
        raise InputError(
            f"{quote_path(described.path)}: the gripper closes from {opened:g} to {closed:g}, and "
            f"closing_sign is {gripper.closing_sign}: correct one of them. (gripper.open_at, "
            "gripper.closed_at)"
        )
    points = [_tip(mj, tip.frame, tip.offset_m) for tip in gripper.tips]
    tips = {}
    for value in (opened, closed):
        data = _resting(described, mj)
        data.qpos[mj.joint(gripper.joints[0]).qposadr[0]] = value
        others = [mj.joint(name) for name in (*gripper.joints[1:], *described.fixed)]
        free, follow = (
            np.array([getattr(j, n)[0] for j in others], int) for n in ("dofadr", "qposadr")
        )
        close_loops(mj, data, free, follow)
        world = [tip_point(data.body(body), point) for body, point in points]
        tips[value] = transform(invert(pose_of(data.body(palm))), np.array(world))
    check_closing(described, tips[opened], tips[closed])
    along = _across_motion(tips[opened], tips[closed])
    length = float(np.linalg.norm(along))
    if gripper.approach is None and length < MIN_APPROACH_M:
        raise InputError(
            f"{quote_path(described.path)}: the closed tips are {1000 * length:.1f} mm from the "
            f"origin of {quote(mj.body(palm).name)}, which gives no direction of the fingers: give "
            "it in axes of that body, such as [0.0, 0.0, 1.0]. (gripper.approach)"
        )
    approach = gripper.approach or _point(along / length)
    ranges = [limits_of(mj, name) or (0.0, 0.0) for name in described.joints]
    return Arm(
        name=described.name,
        title=described.title,
        suits=quote_path(described.path),
        model=("", described.model.name),
        joints=described.joints,
        home=described.home or tuple(float(np.mean(limits)) for limits in ranges),
        speeds=described.speeds or tuple(urdf.speeds[name] for name in described.joints),
        reach_m=0.0,
        gripper=Gripper(
            body=mj.body(palm).name,
            approach=approach,
            tips=((points[0][0], points[0][1]), (points[1][0], points[1][1])),
            driver=gripper.joints[0],
            open=opened,
            closed=closed,
            speed_m_s=gripper.speed_m_s,
        ),
    )


def _across_motion(opened: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Return the way to the middle of the closed tips, across the motion of the fingers."""
    motion = (opened[1] - opened[0]) - (closed[1] - closed[0])
    motion /= np.linalg.norm(motion)
    middle = closed.mean(axis=0)
    return middle - (middle @ motion) * motion


def _resting(described: Description, mj: Any) -> Any:
    """Return the model's data with the joints that rest at their positions."""
    mujoco: Any = import_module("mujoco")

    data = mujoco.MjData(mj)
    for name, value in described.fixed.items():
        data.qpos[mj.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(mj, data)
    return data


def _palm(described: Description, mj: Any) -> int:
    """Return the number of the body that the fingers are mounted on."""
    if described.gripper.body is not None:
        return int(mj.body(described.gripper.body).id)
    paths = []
    for tip in described.gripper.tips:
        body, path = _body(mj, tip.frame), []
        while body:
            path.append(body)
            body = int(mj.body_parentid[body])
        paths.append(path)
    shared = [body for body in paths[0] if body in paths[1]]
    if not shared:
        raise InputError(
            f"{quote_path(described.path)}: the tips hang on no common body: they must be of one "
            "gripper. (gripper.tips)"
        )
    return shared[0]


def _body(mj: Any, frame: str) -> int:
    """Return the number of the body of a frame."""
    names = [mj.body(n).name for n in range(mj.nbody)]
    return names.index(frame) if frame in names else int(mj.site_bodyid[mj.site(frame).id])


def _frame(mj: Any, data: Any, frame: str) -> np.ndarray:
    """Return the pose of a body or site in the world."""
    names = [mj.body(n).name for n in range(mj.nbody)]
    if frame in names:
        return pose_of(data.body(frame))
    pose, site = np.eye(4), data.site(frame)
    pose[:3, :3], pose[:3, 3] = site.xmat.reshape(3, 3), site.xpos
    return pose


def _tip(mj: Any, frame: str, offset_m: Point) -> tuple[str, Point]:
    """Return a point of a frame as its body and a point in the body's axes."""
    mujoco: Any = import_module("mujoco")

    data = mujoco.MjData(mj)
    mujoco.mj_kinematics(mj, data)
    number = _body(mj, frame)
    local = invert(pose_of(data.body(number))) @ _frame(mj, data, frame)
    return mj.body(number).name, _point(local[:3, :3] @ np.array(offset_m, float) + local[:3, 3])


def _point(values: np.ndarray) -> Point:
    x, y, z = values.tolist()
    return x, y, z


def _interval(limits: tuple[float, float]) -> str:
    return f"[{limits[0]:.4g}, {limits[1]:.4g}]"
