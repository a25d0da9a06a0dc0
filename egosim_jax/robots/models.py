"""MuJoCo models of arms: loading, and the positions of a gripper's joints by its opening.

The arm is at the origin of its base frame, z upwards. The table is a plane below it.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.io.bounded import quote, quote_path, refusing
from egosim_jax.io.untrusted.isolated import read_file
from egosim_jax.io.untrusted.mjcf import check_files
from egosim_jax.robots.arms import Arm, Gripper
from egosim_jax.types import InputError

TABLE = "table of egosim"
"""Name of the plane of the table."""
GRIP = "grip of egosim"
"""Name of the site at the grip (`retarget.py`)."""
MOUNTED = "mounted/"
"""Prefix of the names of a gripper that is attached to the arm."""
OPENINGS = 33
"""Number of positions of the gripper in its table."""
MIN_TRAVEL = 0.8
"""Minimum travel of a finger, as a share of the other finger's."""
MAX_MEMORY, MAX_CPU_S = 1 << 30, 60.0
"""Maximum memory in bytes and processor time in seconds to compile a model."""
MAX_PARTS = 500
"""Maximum number of geometries, and of degrees of freedom: kinematics compare them in pairs."""
RESTORE = "restore the model from the MuJoCo Menagerie. (MENAGERIE_ROOT)"
"""Fix of a model that is not the Menagerie's."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class RobotModel:
    """Compiled model of an arm, and what its gripper does."""

    arm: Arm
    """Arm of the model."""
    mj: Any
    """MuJoCo's model (MjModel)."""
    joint_at: Int[np.ndarray, " j"]
    """Index of each arm joint's position in `qpos`."""
    gripper_at: Int[np.ndarray, " k"]
    """Index of the position of each joint of the gripper in `qpos`."""
    gripper_dofs: Int[np.ndarray, " k"]
    """Index of the velocity of each joint of the gripper."""
    site: int
    """Number of the site at the grip."""
    openings_m: Float[np.ndarray, " n"]
    """Openings in the table of the gripper, ascending from 0."""
    positions: Float[np.ndarray, "n k"]
    """Positions of the gripper's joints at each opening."""
    grips_m: Float[np.ndarray, "n 3"]
    """Place of the grip, in the frame of the gripper's body, at each opening."""

    @property
    def largest_m(self) -> float:
        """Largest opening of the gripper."""
        return float(self.openings_m[-1])

    @property
    def home(self) -> Float[np.ndarray, " q"]:
        """Positions of all joints with the arm at home and the gripper open."""
        q = self.mj.qpos0.copy()
        q[self.joint_at], q[self.gripper_at] = self.arm.home, self.positions[-1]
        return q

    def open(self, q: np.ndarray, opening_m: float) -> Float[np.ndarray, " q"]:
        """Return the positions of all joints with the gripper at an opening; move the site."""
        q = q.copy()
        q[self.gripper_at] = _between(self.openings_m, self.positions, opening_m)
        self.mj.site_pos[self.site] = _between(self.openings_m, self.grips_m, opening_m)
        return q


def check_installed() -> None:
    """Raise `InputError` unless the packages of the extra `robot` are installed."""
    if missing := [name for name in ("mujoco", "mujoco_menagerie", "mink") if not find_spec(name)]:
        raise InputError(
            f"Robots need {', '.join(missing)}, which is not installed: pip install "
            "'egosim-jax[robot]'."
        )


def load_model(arm: Arm) -> RobotModel:
    """Return the model of an arm from the Menagerie, which is downloaded on first use.

    Raises `InputError` if its files lead out of their folder, or lack a part that the arm needs.
    """
    check_installed()
    models = [arm.model, *([arm.gripper.model] if arm.gripper.model else [])]
    files = [_file_of(*model) for model in models]
    return read_file(_load, files[0], files, arm, max_memory=MAX_MEMORY, max_cpu_s=MAX_CPU_S)


def _file_of(folder: str, name: str) -> Path:
    import mujoco_menagerie

    try:
        model = mujoco_menagerie.get(folder)
        check_files(model.path())
        return model.xml(name)
    except mujoco_menagerie.MenagerieError as error:
        raise InputError(
            f"The model {folder} of the MuJoCo Menagerie cannot be had: {error} Connect to the "
            "network once, or set MENAGERIE_ROOT to a checkout of the Menagerie."
        ) from error


def _load(path: Path, files: list[Path], arm: Arm) -> RobotModel:
    """Return the model of an arm from its files; this runs in a child process."""
    mujoco: Any = import_module("mujoco")

    with refusing(f"{quote_path(path)} is no model of {arm.title}"):
        spec, *grippers = [mujoco.MjSpec.from_file(str(file)) for file in files]
        for gripper in grippers:
            gripper.option.impratio, gripper.option.cone = spec.option.impratio, spec.option.cone
            site = _part(spec, "site", arm.mount)
            spec.attach(gripper, prefix=MOUNTED, site=site)
        return make_model(arm, spec)


def _part(spec: Any, kind: str, name: str) -> Any:
    """Return a body, joint or site of a specification. Raises `InputError` if it is missing."""
    if (found := getattr(spec, kind)(name)) is None:
        raise InputError(
            f"The robot's model has no {kind} {name!r}, which the arm needs: {RESTORE}"
        )
    return found


def make_model(arm: Arm, spec: Any, *, fix: str = RESTORE) -> RobotModel:
    """Return the model of an arm from its specification, with a plane for the table.

    Raises `InputError`, which ends with `fix`, if a body, a joint or the equality of a finger is
    missing.
    """
    mujoco: Any = import_module("mujoco")

    prefix = MOUNTED if arm.gripper.model else ""
    for key in list(spec.keys):
        spec.delete(key)  # their sizes do not fit a mounted gripper
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name=TABLE, type=plane, size=[2, 2, 0.1], group=5)
    for name in (*arm.joints, prefix + arm.gripper.driver):
        _part(spec, "joint", name)
    for name, _ in arm.gripper.tips:
        _part(spec, "body", prefix + name)
    _part(spec, "body", prefix + arm.gripper.body).add_site(name=GRIP, group=5)
    mj = spec.compile()
    _check_parts(mj, arm, fix)
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    joints = [mj.joint(name) for name in arm.joints]
    gripper = [j for j in map(mj.joint, range(mj.njnt)) if j.name not in arm.joints]
    openings, positions, grips = _sweep(mj, arm.gripper, prefix, gripper, fix)
    site = mj.site(GRIP).id
    # The compiler marks frames at the origin of its body, and MuJoCo then ignores its own pose.
    mj.site_sameframe[site] = mj.geom_sameframe[mj.geom(TABLE).id] = 0
    mujoco.mju_mat2Quat(mj.site_quat[site], grips[-1, :3, :3].ravel())
    return RobotModel(
        arm=arm,
        mj=mj,
        joint_at=np.array([j.qposadr[0] for j in joints]),
        gripper_at=np.array([j.qposadr[0] for j in gripper]),
        gripper_dofs=np.array([j.dofadr[0] for j in gripper]),
        site=site,
        openings_m=openings,
        positions=positions,
        grips_m=grips[:, :3, 3],
    )


def _check_parts(mj: Any, arm: Arm, fix: str) -> None:
    """Raise `InputError` for too many parts, and for a joint that has more than one position."""
    mujoco: Any = import_module("mujoco")

    if max(mj.ngeom, mj.nv) > MAX_PARTS:
        raise InputError(
            f"The robot's model has {mj.ngeom:,} geometries and {mj.nv:,} degrees of freedom: it "
            f"may have at most {MAX_PARTS} of each; {fix}"
        )
    single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    for n in range(mj.njnt):
        if mujoco.mjtJoint(int(mj.jnt_type[n])) not in single:
            raise InputError(
                f"The joint {quote(mj.joint(n).name)} of the robot's model is neither a hinge nor "
                f"a slide, which {arm.title} has; {fix}"
            )


def _sweep(
    mj: Any, gripper: Gripper, prefix: str, joints: list[Any], fix: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return opening, joint positions and grip while the driver moves from closed to open."""
    mujoco: Any = import_module("mujoco")

    data = mujoco.MjData(mj)
    driver = mj.joint(prefix + gripper.driver)
    at = np.array([j.qposadr[0] for j in joints])
    others = [j for j in joints if j.id != driver.id]
    free, follow = (np.array([getattr(j, n)[0] for j in others]) for n in ("dofadr", "qposadr"))
    gaps, positions, grips, places = [], [], [], []
    for value in np.linspace(gripper.open, gripper.closed, OPENINGS):
        data.qpos[driver.qposadr[0]] = value
        close_loops(mj, data, free, follow)
        body = pose_of(data.body(prefix + gripper.body))
        tips = [tip_point(data.body(prefix + name), point) for name, point in gripper.tips]
        first, second = ((tip - body[:3, 3]) @ body[:3, :3] for tip in tips)
        places.append([first, second])
        grips.append(_grip(first, second, np.array(gripper.approach, float)))
        gaps.append((second - first) @ grips[0][:3, 0])
        positions.append(data.qpos[at])
    _check_fingers(mj, gripper, prefix, np.array(places), fix)
    gaps = np.array(gaps) - gaps[-1]
    order = np.argsort(gaps)
    return gaps[order], np.array(positions)[order], np.array(grips)[order]


def _check_fingers(
    mj: Any, gripper: Gripper, prefix: str, places: Float[np.ndarray, "n 2 3"], fix: str
) -> None:
    """Raise `InputError` if two fingers with joints do not move alike.

    MuJoCo leaves a joint without equality where it is, and the gripper would open by half.
    """
    travels_m = np.linalg.norm(places[0] - places[-1], axis=-1)
    chains = []
    for name, _ in gripper.tips:
        body, joints = mj.body(prefix + name), []
        while body.id and body.name != prefix + gripper.body:
            joints += [mj.joint(body.jntadr[0] + n).name for n in range(body.jntnum[0])]
            body = mj.body(body.parentid[0])
        chains.append(joints)
    if all(chains) and travels_m.min() < MIN_TRAVEL * travels_m.max():
        names = [name for joints in chains for name in joints if name != prefix + gripper.driver]
        raise InputError(
            "The fingers of the robot's model move {:.1f} and {:.1f} mm ".format(*1000 * travels_m)
            + f"with the joint {gripper.driver!r}: an equality of {names[0]!r} is missing or "
            f"wrong; {fix}"
        )


def close_loops(mj: Any, data: Any, free: np.ndarray, follow: np.ndarray) -> None:
    """Move the joints that follow the driver until the model's equalities hold (Gauss-Newton)."""
    mujoco: Any = import_module("mujoco")

    for _ in range(30):
        mujoco.mj_fwdPosition(mj, data)
        if not (data.ne and len(free)) or np.abs(data.efc_pos[: data.ne]).max() < 1e-7:
            return
        rows = data.efc_J.reshape(data.nefc, mj.nv)[: data.ne, free]
        step = np.linalg.lstsq(rows, data.efc_pos[: data.ne], rcond=1e-6)[0]
        data.qpos[follow] -= np.clip(step, -0.2, 0.2)


def _grip(first: np.ndarray, second: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """Return the grip's pose from both tips, in the frame of the body."""
    across = second - first
    across = across - (across @ approach) * approach
    across /= max(float(np.linalg.norm(across)), 1e-9)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([across, np.cross(approach, across), approach], axis=1)
    pose[:3, 3] = (first + second) / 2
    return pose


def tip_point(body: Any, point: tuple[float, float, float]) -> np.ndarray:
    """Return a point of a body in the world."""
    return body.xpos + body.xmat.reshape(3, 3) @ np.array(point, float)


def pose_of(body: Any) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a body in the world."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = body.xmat.reshape(3, 3), body.xpos
    return pose


def _between(openings: np.ndarray, values: np.ndarray, opening_m: float) -> np.ndarray:
    return np.array([np.interp(opening_m, openings, column) for column in values.T])


def grip_of(robot: RobotModel, data: Any) -> Float[np.ndarray, "4 4"]:
    """Return the pose of the grip in the base frame."""
    pose = np.eye(4)
    pose[:3, :3] = data.site_xmat[robot.site].reshape(3, 3)
    pose[:3, 3] = data.site_xpos[robot.site]
    return pose


def limits_of(mj: Any, joint: str) -> tuple[float, float] | None:
    """Return the limits of a joint; None if it has none."""
    if not mj.jnt_limited[mj.joint(joint).id]:
        return None
    low, high = mj.joint(joint).range.tolist()
    return low, high


def is_slide(mj: Any, joint: str) -> bool:
    """Return True for a joint that slides, False for a hinge."""
    mujoco: Any = import_module("mujoco")

    return int(mj.jnt_type[mj.joint(joint).id]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
