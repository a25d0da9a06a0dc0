"""Inverse kinematics: joint positions that follow a path of grips, as far as the arm can.

Each frame solves quadratic programs (mink) for the pinch point first and the direction second.
Joint limits, speed limits, the table and the arm itself are constraints, so a path that the arm
cannot follow is not followed; the track says by how much.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from egosim_jax.robots.models import GRIP, TABLE, RobotModel, grip_of
from egosim_jax.robots.retarget import GRADUAL_S

REACHED_M = 0.005
"""Distance of the robot's pinch point from the hand's up to which a frame is reached."""
TURN_COST = 0.02
"""Meters of the pinch point that weigh as much as a radian of direction."""
POSTURE_COST = 1e-3
"""Meters of the pinch point that weigh as much as a radian away from home."""
STEPS = 12
"""Solutions per frame of a video."""
SEARCH_STEP_S = 0.1
"""Time of a step of a search, at the joints' maximum speed."""
CLEARANCE_M, WATCHED_M = 0.001, 0.04
"""Least distance from the table and between links; distance from which a pair is watched."""


GAIN, LIFT_M = 0.5, 0.001
"""Share of a gap that a step may close; lift of a link below the table, per step."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Track:
    """Motion of an arm along a path of grips, in its base frame."""

    q: Float[np.ndarray, "f q"]
    """Positions of all joints of the model."""
    opening_m: Float[np.ndarray, " f"]
    """Opening of the gripper."""
    base_from_grip: Float[np.ndarray, "f 4 4"]
    """Pose of the grip."""
    error_m: Float[np.ndarray, " f"]
    """Distance of the pinch point from the path's."""
    turn_error: Float[np.ndarray, " f"]
    """Angle between the grip and the path's, in radians."""
    clearance_m: Float[np.ndarray, " f"]
    """Least distance of a moving link from the table; negative below it."""
    apart_m: Float[np.ndarray, " f"]
    """Least distance of the gripper from the arm's other links, at most `WATCHED_M`."""

    @property
    def reached(self) -> Bool[np.ndarray, " f"]:
        """Mask of the frames whose pinch point is reached."""
        return self.error_m <= REACHED_M


class Solver:
    """Inverse kinematics of one arm above a table."""

    def __init__(self, robot: RobotModel, *, table_m: float = 0.0) -> None:
        import mink

        self.robot, self.mink = robot, mink
        robot.mj.geom(TABLE).pos[2] = table_m
        self.configuration = mink.Configuration(robot.mj, q=robot.home)
        self.links = _links(robot.mj)
        self.frame = mink.FrameTask(
            GRIP, "site", position_cost=1.0, orientation_cost=TURN_COST, lm_damping=1e-3
        )
        posture = mink.PostureTask(robot.mj, cost=POSTURE_COST)
        posture.set_target(robot.home)
        self.tasks = [self.frame, posture]
        self.frozen = [mink.DofFreezingTask(robot.mj, robot.gripper_dofs.tolist())]
        speeds = dict(zip(robot.arm.joints, robot.arm.speeds, strict=True))
        self.apart = mink.CollisionAvoidanceLimit(
            robot.mj,
            _apart(robot, self.links),
            minimum_distance_from_collisions=CLEARANCE_M,
            collision_detection_distance=WATCHED_M,
        )
        self.limits = [
            mink.ConfigurationLimit(robot.mj),
            mink.VelocityLimit(robot.mj, speeds),
            self.apart,
            _table_limit(robot, self.links),
        ]

    def approach(
        self, q: np.ndarray, base_from_grip: np.ndarray, opening_m: float, *, steps: int
    ) -> Float[np.ndarray, " q"]:
        """Return a posture near a grip, from the posture `q`, without a limit of time."""
        return self._solve(q, base_from_grip, opening_m, steps=steps, step_s=SEARCH_STEP_S)

    def follow(
        self,
        q: np.ndarray,
        base_from_grip: Float[np.ndarray, "f 4 4"],
        opening_m: Float[np.ndarray, " f"],
        *,
        fps: int | float,
    ) -> Track:
        """Return the motion along a path from the posture `q`, at which the path begins."""
        openings = self._limit_opening(opening_m, fps)
        found = []
        for frame, (pose, opening) in enumerate(zip(base_from_grip, openings, strict=True)):
            if frame:
                step_s = 1 / (fps * STEPS)
                q = self._solve(q, pose, float(opening), steps=STEPS, step_s=step_s)
            else:
                q = self.robot.open(q, float(opening))
            found.append(q)
        return self.measure(np.array(found), openings, base_from_grip)

    def measure(self, q: np.ndarray, openings: np.ndarray, base_from_grip: np.ndarray) -> Track:
        """Return the track of some postures, compared with the path that they follow."""
        mujoco: Any = import_module("mujoco")

        mj, grips, clearances, apart = self.robot.mj, [], [], []
        ends, table = np.zeros(6), mj.geom(TABLE).id
        for posture, opening in zip(q, openings, strict=True):
            data = posed(self.robot, self.robot.open(posture, float(opening)))
            grips.append(grip_of(self.robot, data))
            gaps = [mujoco.mj_geomDistance(mj, data, table, n, 1.0, ends) for n in self.links]
            clearances.append(min(gaps))
            gaps = [
                mujoco.mj_geomDistance(mj, data, a, b, WATCHED_M, ends)
                for a, b in self.apart.geom_id_pairs
            ]
            apart.append(min(gaps, default=WATCHED_M))
        grips = np.array(grips)
        turn = np.einsum("fij,fij->f", grips[:, :3, :3], base_from_grip[:, :3, :3])
        return Track(
            q=q,
            opening_m=openings,
            base_from_grip=grips,
            error_m=np.linalg.norm(grips[:, :3, 3] - base_from_grip[:, :3, 3], axis=1),
            turn_error=np.arccos(np.clip((turn - 1) / 2, -1, 1)),
            clearance_m=np.array(clearances),
            apart_m=np.array(apart),
        )

    def _limit_opening(self, opening_m: np.ndarray, fps: int | float) -> Float[np.ndarray, " f"]:
        """Return the openings that the gripper can have, at most at its speed, without jerks."""
        wanted = np.clip(opening_m, self.robot.openings_m[0], self.robot.openings_m[-1])
        wanted = gaussian_filter1d(wanted, GRADUAL_S * fps, mode="nearest")
        step, found = self.robot.arm.gripper.speed_m_s / fps, [wanted[0]]
        for value in wanted[1:]:
            found.append(np.clip(value, found[-1] - step, found[-1] + step))
        return np.array(found)

    def _solve(
        self, q: np.ndarray, pose: np.ndarray, opening_m: float, *, steps: int, step_s: float
    ) -> np.ndarray:
        mink, configuration = self.mink, self.configuration
        configuration.update(self.robot.open(q, opening_m))
        self.frame.set_target(mink.SE3.from_matrix(pose))
        self.apart.gain = GAIN * step_s  # mink's gain is a share per second, not per step
        for _ in range(steps):
            try:
                speed = mink.solve_ik(
                    configuration, self.tasks, step_s, "daqp", damping=1e-9,
                    limits=self.limits, constraints=self.frozen,
                )  # fmt: skip
            except mink.NoSolutionFound:
                break  # the links cannot leave a collision within their limits
            configuration.integrate_inplace(speed, step_s)
            if np.abs(speed).max() * step_s < 1e-5:
                break
        return configuration.q.copy()


def posed(robot: RobotModel, q: Float[np.ndarray, " q"]) -> Any:
    """Return MuJoCo's data with the bodies of a robot at the positions of its joints."""
    mujoco: Any = import_module("mujoco")

    data = mujoco.MjData(robot.mj)
    data.qpos[:] = q
    mujoco.mj_kinematics(robot.mj, data)
    return data


def _table_limit(robot: RobotModel, links: list[int]) -> Any:
    """Return the limit of mink that keeps geometries above the table, and lifts those below it.

    Mink's own limit for collisions only stops them, and a corner that turns down goes below.
    """
    import mink

    mujoco: Any = import_module("mujoco")

    mj, table = robot.mj, robot.mj.geom(TABLE).id
    ends, jacobian = np.zeros(6), np.zeros((3, mj.nv))

    class TableLimit(mink.Limit):
        def compute_qp_inequalities(self, configuration: Any, dt: float) -> Any:
            rows, bounds = [], []
            for n in links:
                gap = mujoco.mj_geomDistance(mj, configuration.data, table, n, WATCHED_M, ends)
                if gap < WATCHED_M:
                    mujoco.mj_jac(
                        mj, configuration.data, jacobian, None, ends[3:], mj.geom_bodyid[n]
                    )
                    rows.append(-jacobian[2])
                    bounds.append(max(GAIN * (gap - CLEARANCE_M), -LIFT_M))
            if not rows:
                return mink.Constraint()
            return mink.Constraint(G=np.array(rows), h=np.array(bounds))

    return TableLimit()


def _links(mj: Any) -> list[int]:
    """Return the geometries that can collide and that move."""
    return [
        n
        for n in range(mj.ngeom)
        if (mj.geom_contype[n] or mj.geom_conaffinity[n]) and mj.body_weldid[mj.geom_bodyid[n]]
    ]


def _apart(robot: RobotModel, links: list[int]) -> list[tuple[list[int], list[int]]]:
    """Return the pairs of an arm's and its gripper's geometries that are apart at home.

    Collision meshes of neighbors overlap in every posture. The gripper can meet the base and the
    first links; others are farther apart.
    """
    mujoco: Any = import_module("mujoco")

    mj, data, ends = robot.mj, posed(robot, robot.home), np.zeros(6)
    gripper_body = mj.body_weldid[mj.site_bodyid[robot.site]]
    tail = [n for n in links if _is_under(mj, int(mj.geom_bodyid[n]), int(gripper_body))]
    solid = [n for n in range(mj.ngeom) if mj.geom_contype[n] or mj.geom_conaffinity[n]]
    head = [n for n in solid if n not in tail and n != mj.geom(TABLE).id]
    pairs = []
    for n in tail:
        far = [m for m in head if mujoco.mj_geomDistance(mj, data, n, m, 0.2, ends) > WATCHED_M]
        pairs += [([n], far)] if far else []
    return pairs


def _is_under(mj: Any, body: int, ancestor: int) -> bool:
    while body and body != ancestor:
        body = int(mj.body_parentid[body])
    return body == ancestor
