"""Data types check their values when they are made."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from egosim_jax.types import (
    Action,
    Clip,
    GroundTruth,
    InputError,
    SceneState,
    VideoSpec,
    check_seed,
)
from egosim_jax.worlds.tabletop import make_sequence, to_action

SPEC = VideoSpec(frames=5, height=48, width=80, fps=8)


@cache
def action(kind: str = "human", seed: int = 3) -> Action:
    return to_action(next(make_sequence(seed, spec=SPEC, kind=kind)))


def joints(change) -> np.ndarray:
    changed = action().joints_m.copy()
    change(changed)
    return changed


def one_nan(joints):
    joints[2, 0, 5, 1] = np.nan


def infinite(joints):
    joints[2, 0] = np.inf


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints_m": action().joints_m[:, :, :20]}, r"\(5, 2, 20, 3\).*\(5, hands, 21, 3\)"),
        ({"joints_m": np.repeat(action().joints_m, 3, axis=0)}, r"\(15, 2, 21, 3\)"),
        ({"joints_m": action().joints_m[:, :0]}, "at least one hand"),
        ({"joints_m": action().joints_m[:, 0]}, r"\(5, 21, 3\)"),
        ({"joints_m": np.zeros((5, 2, 21, 3), int)}, "must be floats"),
        ({"kind": "gripper"}, "must be 'human' or 'robot', not 'gripper'"),
        ({"kind": "robot"}, r"\(5, hands, 3, 3\)"),
        ({"joints_m": 1000 * action().joints_m}, "Joints must be in meters"),
        ({"joints_m": action().joints_m / 1000}, "Joints must be in meters"),
        ({"joints_m": action().joints_m + [0, -9, 0]}, "must be in world coordinates"),
        ({"joints_m": joints(one_nan)}, "Hand 0 of frame 2 is only partly finite"),
        ({"joints_m": joints(infinite)}, "Hand 0 of frame 2 is only partly finite"),
        ({"prompt": None}, "The prompt must be text, not NoneType"),
    ],
)
def test_an_action_that_cannot_be_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        replace(action(), **changes)


def test_joints_in_the_frame_of_the_camera_are_refused():
    given = action(seed=5)
    inverse = np.linalg.inv(given.cameras.world_from_camera)
    points = np.einsum("fab,fnjb->fnja", inverse[:, :3, :3], given.joints_m)
    points += inverse[:, None, None, :3, 3]
    with pytest.raises(InputError, match="must be in world coordinates"):
        replace(given, joints_m=points)


def test_hands_may_be_missing_now_and_then_or_all_the_time():
    for frames in (slice(2, 4), slice(None)):
        missing = action().joints_m.copy()
        missing[frames] = np.nan
        replace(action(), joints_m=missing)


def test_a_gripper_is_taken():
    assert action("robot").joints_m.shape[2] == 3


@pytest.mark.parametrize(
    "changes",
    [
        {"world_from_camera": np.eye(4)},
        {"world_from_camera": np.zeros((5, 3, 4))},
        {"intrinsics_px": np.eye(4)},
    ],
)
def test_cameras_of_another_shape_are_refused(changes):
    with pytest.raises(InputError, match="has shape"):
        replace(action().cameras, **changes)


@pytest.mark.parametrize(
    "frames", [np.zeros((2, 8, 8, 3)), np.zeros((2, 8, 8, 4), np.uint8), np.zeros(3, np.uint8)]
)
def test_a_clip_that_is_no_video_is_refused(frames):
    with pytest.raises(InputError, match="must be uint8"):
        Clip(frames=frames, fps=8)


@pytest.mark.parametrize("seed", [-1, 2**63, 2**64])
def test_a_seed_out_of_range_is_refused(seed):
    with pytest.raises(InputError, match=r"--seed must be a whole number from 0 to 2\*\*63 - 1"):
        check_seed(seed)


K = np.array([[60.0, 0, 39.5], [0, 60, 23.5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"intrinsics_px": K.T}, "implausible"),
        ({"intrinsics_px": np.diag([1 / 80, 1 / 48, 1]) @ K}, "implausible"),
        ({"intrinsics_px": np.diag([20, 20, 1]) @ K}, "implausible"),
        ({"intrinsics_px": K.tolist()}, "must be an array of numbers"),
        ({"world_from_camera": np.zeros((0, 4, 4))}, "at least one frame"),
        (
            {"world_from_camera": action().cameras.world_from_camera.swapaxes(1, 2)},
            "last row 0 0 0 1",
        ),
        ({"height": 48.0}, "whole numbers"),
    ],
)
def test_cameras_in_another_convention_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        replace(action().cameras, **changes)


@pytest.mark.parametrize("away", [9.0, 4.0])
def test_each_hand_must_be_within_reach(away):
    given = action()
    other = given.joints_m[:, :1] + away * given.cameras.world_from_camera[:, None, None, :3, 2]
    with pytest.raises(InputError, match="No joint of hand 1 comes near"):
        replace(given, joints_m=np.concatenate([given.joints_m[:, :1], other], axis=1))
    other[:] = np.nan
    replace(given, joints_m=np.concatenate([given.joints_m[:, :1], other], axis=1))


@pytest.mark.parametrize(
    "changes",
    [
        {"points_m": np.zeros((2, 3))},
        {"colors": np.zeros((2, 3), np.float32)},
        {"object_ids": np.zeros(2, np.int64)},
        {"last_seen": np.zeros((2, 1), np.int32)},
        {"intrinsics_px": np.eye(4)},
    ],
)
def test_a_state_of_other_shapes_or_dtypes_is_refused(changes):
    fields = {
        "points_m": np.zeros((2, 3), np.float32),
        "colors": np.zeros((2, 3), np.uint8),
        "object_ids": np.zeros(2, np.int32),
        "last_seen": np.zeros(2, np.int32),
        "intrinsics_px": np.eye(3),
    }
    SceneState(**fields)
    with pytest.raises(InputError, match=next(iter(changes))):
        SceneState(**{**fields, **changes})


def test_ground_truth_motions_are_rigid():
    frames, motion = np.zeros((2, 4, 4, 3), np.uint8), np.tile(np.eye(4), (2, 1, 1))
    GroundTruth(frames=frames, motions={1: motion})
    with pytest.raises(InputError, match="rigid transform per frame"):
        GroundTruth(frames=frames, motions={1: 2 * motion})
