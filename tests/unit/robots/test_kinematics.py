"""Grips of hands, the gripper's table, and the motion of an arm along a path."""

import numpy as np
import pytest

pytest.importorskip("mink")

from egosim_jax.geometry import look_at
from egosim_jax.robots.ik import Solver
from egosim_jax.robots.models import GRIP
from egosim_jax.robots.placement import _covered, _view, place
from egosim_jax.robots.retarget import grips_of
from egosim_jax.types import Cameras
from tests.unit.robots.toy import TOY, make_toy

FPS, FRAMES = 8, 9
DOWN = np.diag([1.0, -1.0, -1.0])
"""Axes of a grip from above."""
EYE = np.array([0.0, -0.2, 0.5])
"""Place of the camera."""


@pytest.fixture(scope="module")
def toy():
    return make_toy()


def path_to(*places_m):
    """Return grips from above, along straight lines."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = DOWN
    knots = np.linspace(0, 1, len(places_m))
    for axis, values in enumerate(np.transpose(places_m)):
        poses[:, axis, 3] = np.interp(np.linspace(0, 1, FRAMES), knots, values)
    return poses


def watch(eye_m, target_m):
    """Return the pose of a camera that looks at a place."""
    return look_at(eye_m, np.asarray(target_m), up=np.array([0.0, 0.0, 1.0]))


def seen_by(poses, focal_px=60.0):
    """Return cameras of images of 80 x 48 pixels."""
    lens = np.array([[focal_px, 0, 39.5], [0, focal_px, 23.5], [0, 0, 1.0]])
    return Cameras(world_from_camera=poses, intrinsics_px=lens, height=48, width=80)


def gripper(poses, opening_m):
    """Return the three keypoints of grips."""
    tip = poses[:, :3, 0] * opening_m / 2
    place = poses[:, :3, 3]
    return np.stack([place - 0.12 * poses[:, :3, 2], place - tip, place + tip], axis=1)


def follow(toy, poses, table_m=0.0):
    solver, openings = Solver(toy, table_m=table_m), np.full(FRAMES, 0.05)
    start = solver.approach(toy.home, poses[0], 0.05, steps=60)
    return solver.follow(start, poses, openings, fps=FPS)


def test_a_grip_has_the_pose_of_its_keypoints():
    poses = path_to([0.3, 0.1, 0.2], [0.3, 0.1, 0.2])
    grips = grips_of(gripper(poses, 0.06), fps=FPS)
    np.testing.assert_allclose(grips.world_from_grip, poses, atol=1e-9)
    np.testing.assert_allclose(grips.opening_m, 0.06)


def test_a_missing_hand_stays_where_it_was_seen_last():
    joints = gripper(path_to([0.3, 0, 0.2], [0.4, 0, 0.2]), 0.06)
    joints[4:6] = np.nan
    grips = grips_of(joints, fps=FPS)
    assert grips.seen.tolist() == [True] * 4 + [False] * 2 + [True] * 3
    np.testing.assert_array_equal(grips.world_from_grip[4], grips.world_from_grip[3])
    assert np.isnan(grips.pinch_m[4:6]).all()


def test_a_closed_grip_keeps_its_direction():
    joints = gripper(path_to([0.3, 0, 0.2], [0.3, 0, 0.2]), 0.06)
    joints[3:, 1:] = joints[3:, 1:].mean(axis=1, keepdims=True)
    turns = grips_of(joints, fps=FPS).world_from_grip[:, :3, :3]
    np.testing.assert_allclose(turns, np.broadcast_to(DOWN, turns.shape), atol=1e-9)


def test_the_table_of_a_gripper_follows_its_equality(toy):
    np.testing.assert_allclose(toy.openings_m[[0, -1]], [0, 0.08], atol=1e-9)
    np.testing.assert_allclose(toy.positions[:, 0], toy.positions[:, 1], atol=1e-7)
    q = toy.open(toy.home, 0.03)
    np.testing.assert_allclose(q[toy.gripper_at], 0.015, atol=1e-7)
    np.testing.assert_allclose(toy.mj.site(GRIP).pos, [0, 0, 0.075], atol=1e-9)


def test_a_path_within_reach_is_followed_within_the_limits(toy):
    track = follow(toy, path_to([0.35, -0.1, 0.2], [0.35, 0.1, 0.1], [0.3, 0.1, 0.2]))
    assert track.error_m.max() < 5e-4
    assert track.turn_error.max() < np.radians(2)
    joints = track.q[:, toy.joint_at]
    low, high = np.array([toy.mj.joint(name).range for name in TOY.joints]).T
    assert (joints > low).all()
    assert (joints < high).all()
    assert (np.abs(np.diff(joints, axis=0)) * FPS <= np.array(TOY.speeds) * (1 + 1e-6)).all()
    assert track.clearance_m.min() > 0


def test_the_gripper_closes_gradually_at_most_at_its_speed(toy):
    poses = path_to([0.35, 0, 0.2], [0.35, 0, 0.2])
    openings = np.where(np.arange(FRAMES) < FRAMES // 2, 0.2, 0.07)  # at most 0.08 is possible
    found = Solver(toy, table_m=0.0).follow(toy.home, poses, openings, fps=16).opening_m
    np.testing.assert_allclose(found[[0, -1]], [0.08, 0.07], atol=1e-3)
    steps = -np.diff(found)
    assert (steps >= -1e-12).all()
    assert steps.max() < np.ptp(found) / 2


def test_a_path_out_of_reach_says_by_how_much(toy):
    track = follow(toy, path_to([0.35, 0, 0.2], [0.95, 0, 0.2]))
    assert track.reached[0]
    assert not track.reached[-1]
    assert 0.15 < track.error_m[-1] < 0.45


def test_the_table_stops_the_gripper(toy):
    track = follow(toy, path_to([0.35, 0, 0.2], [0.35, 0, -0.05]))
    assert track.clearance_m.min() > -0.002
    assert not track.reached[-1]
    assert track.error_m[-1] == pytest.approx(0.06, abs=0.02)


def test_a_base_is_found_from_which_the_whole_path_is_reached(toy):
    poses = path_to([0.1, 0.3, 0.15], [-0.1, 0.3, 0.05], [0.0, 0.2, 0.15])
    grips = grips_of(gripper(poses, 0.06), fps=FPS)
    cameras = np.repeat(watch(EYE, [0.0, 0.3, 0.1])[None], FRAMES, axis=0)
    view = {"world_from_up": np.eye(4), "cameras": seen_by(cameras), "fps": FPS}
    placed = place(toy, grips, **view)
    assert placed.track.reached.all()
    assert placed.clear.all()
    base = (*placed.world_from_base[:2, 3], 0.0, 0.0)
    given = place(toy, grips, base=base, **view)
    np.testing.assert_allclose(given.world_from_base[:3, 3], base[:3])
    np.testing.assert_allclose(given.world_from_base[:3, :3], np.eye(3))


def test_frames_in_which_the_arm_is_close_in_front_of_the_camera_are_known(toy):
    poses = path_to([0.1, 0.3, 0.15], [-0.1, 0.3, 0.05], [0.0, 0.2, 0.15])
    grips = grips_of(gripper(poses, 0.06), fps=FPS)
    cameras = np.repeat(watch(EYE, [0.0, 0.3, 0.1])[None], FRAMES, axis=0)
    jaws = poses[5, :3, 3] + [0, 0, 0.03]
    cameras[5] = watch(jaws, jaws + [0, 0.1, 1])  # from between the jaws into the hand
    cameras[7] = watch(jaws, jaws + [0, 1, 0])  # the arm is above and behind this one
    base = (0.0, -0.1, 0.0, 90.0)
    view = {"world_from_up": np.eye(4), "cameras": seen_by(cameras), "fps": FPS}
    placed = place(toy, grips, base=base, **view)
    np.testing.assert_array_equal(np.flatnonzero(~placed.clear), [5])


def test_a_base_from_which_the_arm_covers_less_of_the_image_is_preferred(toy, monkeypatch):
    poses = path_to([0.05, 0.3, 0.1], [-0.05, 0.3, 0.1])
    grips = grips_of(gripper(poses, 0.06), fps=FPS)
    eyes = np.repeat(watch(np.array([0.0, -0.3, 0.4]), [0.0, 0.2, 0.1])[None], FRAMES, axis=0)
    given = {"world_from_up": np.eye(4), "cameras": seen_by(eyes, focal_px=80.0), "fps": FPS}

    mujoco = pytest.importorskip("mujoco")

    def share(placed):
        data = mujoco.MjData(toy.mj)
        data.qpos[:] = placed.track.q[0]
        mujoco.mj_kinematics(toy.mj, data)
        camera = np.linalg.inv(placed.world_from_base) @ eyes[0]
        return _covered(Solver(toy, table_m=0.0), data, camera, _view(given["cameras"]))

    monkeypatch.setattr("egosim_jax.robots.placement.COVER", 0.0)
    monkeypatch.setattr("egosim_jax.robots.placement.COVER_COST", 0.0)
    anywhere = share(place(toy, grips, **given))
    monkeypatch.setattr("egosim_jax.robots.placement.COVER_COST", 100.0)
    chosen = place(toy, grips, **given)
    assert 0 < share(chosen) < anywhere
    assert chosen.track.reached.all()
