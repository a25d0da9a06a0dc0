"""Table of the arms with a gripper that can take the place of a hand.

Models are from the MuJoCo Menagerie (package `mujoco-menagerie`, which downloads them on first use;
`MENAGERIE_ROOT` names a checkout instead). Speeds are from the makers' data sheets.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from math import pi

from egosim_jax.types import InputError

Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """Two fingers that one joint moves; the other joints follow by the model's equalities."""

    model: tuple[str, str] | None = None
    """Folder and model of a gripper that is mounted on the arm; None if the arm has it."""
    body: str
    """Body that the fingers are mounted on."""
    approach: Point
    """Direction of the fingers, in the frame of the body."""
    tips: tuple[tuple[str, Point], tuple[str, Point]]
    """Body of each finger, and the point of its pad that touches what it grasps."""
    driver: str
    """Joint that opens and closes the fingers."""
    open: float
    """Position of the driver at which the gripper is open."""
    closed: float
    """Position of the driver at which the gripper is closed."""
    speed_m_s: float
    """Maximum speed of the opening."""


@dataclass(frozen=True, kw_only=True)
class Arm:
    """A robot arm with a gripper."""

    name: str
    """Name in `egosim robot list`."""
    title: str
    """Name by its maker."""
    suits: str
    """Words on what the arm is good for."""
    model: tuple[str, str]
    """Folder and model in the Menagerie."""
    mount: str = ""
    """Site of the arm to which a separate gripper is attached."""
    joints: tuple[str, ...]
    """Joints of the arm from base to wrist."""
    home: tuple[float, ...]
    """Posture in the middle of the workspace, in radians: where a search begins."""
    speeds: tuple[float, ...]
    """Maximum speed of each joint in radians per second."""
    reach_m: float
    """Distance from the base up to which the gripper works in most directions."""
    gripper: Gripper


PANDA = Arm(
    name="panda",
    title="Franka Emika Panda",
    suits="7 joints: keeps the hand's direction in most of its reach; the arm of DROID",
    model=("franka_emika_panda", "panda"),
    joints=tuple(f"joint{n}" for n in range(1, 8)),
    home=(0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785),
    speeds=(2.175,) * 4 + (2.61,) * 3,
    reach_m=0.75,
    gripper=Gripper(
        body="hand",
        approach=(0.0, 0.0, 1.0),
        tips=(("left_finger", (0.0, 0.0, 0.047)), ("right_finger", (0.0, 0.0, 0.047))),
        driver="finger_joint1",
        open=0.04,
        closed=0.0,
        speed_m_s=0.1,
    ),
)
UR5E = Arm(
    name="ur5e",
    title="Universal Robots UR5e with Robotiq 2F-85",
    suits="6 joints and a long reach: industrial cells, wide motions",
    model=("universal_robots_ur5e", "ur5e"),
    mount="attachment_site",
    joints=(
        "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint",
        "wrist_1_joint", "wrist_2_joint", "wrist_3_joint",
    ),
    home=(-pi / 2, -1.9, 2.1, -1.8, -pi / 2, 0.0),
    speeds=(pi,) * 6,
    reach_m=0.8,
    gripper=Gripper(
        model=("robotiq_2f85", "2f85"),
        body="base",
        approach=(0.0, 0.0, 1.0),
        tips=(("right_pad", (0.0, -0.0066, 0.031)), ("left_pad", (0.0, -0.0066, 0.031))),
        driver="right_driver_joint",
        open=0.0,
        closed=0.8,
        speed_m_s=0.15,
    ),
)  # fmt: skip
XARM7 = Arm(
    name="xarm7",
    title="UFACTORY xArm7",
    suits="7 joints, light: laboratory tables, the hand's direction in most of its reach",
    model=("ufactory_xarm7", "xarm7"),
    joints=tuple(f"joint{n}" for n in range(1, 8)),
    home=(0.0, -0.25, 0.0, 0.9, 0.0, 1.15, 0.0),
    speeds=(pi,) * 7,
    reach_m=0.65,
    gripper=Gripper(
        body="xarm_gripper_base_link",
        approach=(0.0, 0.0, 1.0),
        tips=(("left_finger", (0.0, -0.026, 0.052)), ("right_finger", (0.0, 0.026, 0.052))),
        driver="left_driver_joint",
        open=0.0,
        closed=0.85,
        speed_m_s=0.1,
    ),
)
SO_ARM100 = Arm(
    name="so_arm100",
    title="The Robot Studio SO-ARM100",
    suits="5 joints, low cost: follows the pinch point; the hand's direction only in part",
    model=("trs_so_arm100", "so_arm100"),
    joints=("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll"),
    home=(0.0, -1.7, 1.5, 1.2, -pi / 2),
    speeds=(4.7,) * 5,
    reach_m=0.33,
    gripper=Gripper(
        body="Fixed_Jaw",
        approach=(0.0, -1.0, 0.0),
        tips=(("Moving_Jaw", (-0.0113, -0.077, 0.0)), ("Fixed_Jaw", (0.0089, -0.1014, 0.0))),
        driver="Jaw",
        open=1.2,
        closed=0.0,
        speed_m_s=0.3,
    ),
)
VX300S = Arm(
    name="vx300s",
    title="Trossen ViperX 300 S",
    suits="6 joints: the arm of ALOHA; two of them for two hands",
    model=("trossen_vx300s", "vx300s"),
    joints=("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"),
    home=(0.0, -0.6, 0.7, 0.0, 0.9, 0.0),
    speeds=(pi,) * 6,
    reach_m=0.55,
    gripper=Gripper(
        body="gripper_link",
        approach=(1.0, 0.0, 0.0),
        tips=(("left_finger_link", (0.05, 0.0, 0.0)), ("right_finger_link", (0.05, 0.0, 0.0))),
        driver="left_finger",
        open=0.057,
        closed=0.021,
        speed_m_s=0.2,
    ),
)
ARMS = {arm.name: arm for arm in (PANDA, UR5E, XARM7, SO_ARM100, VX300S)}
"""Arms by name."""


def arm_of(name: str) -> Arm:
    """Return an arm by name; raise `InputError` for an unknown name."""
    if name not in ARMS:
        near = difflib.get_close_matches(name, ARMS, n=1, cutoff=0)[0]
        raise InputError(
            f"There is no robot {name[:40]!r}. Did you mean {near!r}? Known: {', '.join(ARMS)}. "
            "(--robot, egosim robot list)"
        )
    return ARMS[name]
