"""Grips that the fingers do not show, and the falls that follow them, on boxes of points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.dynamics import Prediction
from egosim_jax.dynamics.level import level_scene
from egosim_jax.geometry import look_at
from egosim_jax.types import Action
from tests.scenes import pinhole, state_of

FRAMES = 17
CAMERA = look_at(np.array([0, -0.5, 0.5]), np.zeros(3), up=np.array([0, 0, 1.0]))
CAMERAS = pinhole([CAMERA] * FRAMES, 120.0, 96, 160)
SIDE = np.arange(-0.4, 0.4, 0.01)
TABLE = np.stack(np.meshgrid(SIDE, SIDE, [0.0]), axis=-1).reshape(-1, 3)
EDGE = np.linspace(-1, 1, 9)
BOX = np.stack(np.meshgrid(EDGE, EDGE, EDGE + 1), axis=-1).reshape(-1, 3)
CUBE, BLOCK = 0.02 * BOX, 0.05 * BOX + [0.25, 0, 0]


def make_state(**fields):
    """Return a state of a small cube, a large block and a table."""
    parts = [TABLE, CUBE, BLOCK]
    ids = np.repeat(np.arange(3), [len(part) for part in parts])
    return state_of(np.concatenate(parts), ids=ids, provenance={"world": "tabletop"}, **fields)


def make_action(end_m, released):
    """Return the action of a closed gripper that comes from above, and moves on from frame 2."""
    share = np.clip((np.arange(FRAMES) - 2) / (released - 2), 0, 1)[:, None]
    path = [0, 0, 0.02] + share * (np.array(end_m) - [0, 0, 0.02])
    path[:2, 2] += [0.1, 0.05]
    jaws = [path + [x, 0, 0] for x in (-0.018, 0.018)]
    joints = np.stack([path + [0, 0, 0.12], *jaws], axis=1)[:, None]
    return Action(cameras=CAMERAS, joints_m=joints, kind="robot", prompt="")


@pytest.mark.parametrize(
    ("end_m", "height_m"), [((-0.1, 0, 0.1), 0.0), ((0.25, 0, 0.2), 0.1)], ids=["table", "block"]
)
def test_a_given_grip_carries_an_object_which_then_falls(end_m, height_m):
    prediction = Prediction.of(make_state(), make_action(end_m, released=8))
    assert not prediction.motion().held
    holds = [hold for hold, _ in prediction.possible_grips(0, 1)]
    hold = next(hold for hold in holds if (hold.begin, hold.end) == (2, 8))
    motion = prediction.motion({0: (1, hold)})
    path = motion.paths[1]
    np.testing.assert_allclose(path.motion[8, :3, 3], np.array(end_m) - [0, 0, 0.02], atol=1e-6)
    np.testing.assert_allclose(path.motion[-1, :3, 3], [*end_m[:2], height_m], atol=1e-6)
    assert [cause.how for cause in path.causes] == ["held", "dropped"]
    assert not motion.held


def test_a_hand_far_from_an_object_does_not_hold_it():
    prediction = Prediction.of(make_state(), make_action((0, 0, 0.1), released=8))
    assert not list(prediction.possible_grips(0, 2))


def test_points_without_an_id_are_predicted_like_an_object():
    prediction = Prediction.of(make_state(), make_action((0, 0.1, 0.1), released=8))
    bare = Prediction.of(make_state(held={}), make_action((0, 0.1, 0.1), released=8)).with_object(
        9, CUBE
    )
    (_, expected), *_ = prediction.possible_grips(0, 1)
    (_, path), *_ = bare.possible_grips(0, 9)
    np.testing.assert_allclose(path.motion, expected.motion, atol=1e-9)


def lifted_state():
    """Return the state with the cube in the first hand, 15 cm above the table."""
    pose = np.eye(4)
    pose[:3, 3] = [0.1, 0, 0.15]
    state = make_state(world_from_object={1: pose}, held={0: 1})
    points = state.points_m.copy()
    points[state.object_ids == 1] += pose[:3, 3].astype(np.float32)
    return replace(state, points_m=points)


@pytest.mark.parametrize("down_m", [0.1, 0.3])
def test_a_noisy_hand_keeps_what_it_held_until_it_would_press_it_into_the_table(down_m):
    path = [0.1, 0, 0.17] - np.linspace(0, down_m, FRAMES)[:, None] * [0, 0, 1]
    jaws = [path + [x, 0, 0] for x in (-0.035, 0.035)]  # too wide for the cube
    joints = np.stack([path + [0, 0, 0.12], *jaws], axis=1)[:, None]
    joints = joints + np.random.default_rng(0).normal(0, 0.002, joints.shape)
    action = Action(cameras=CAMERAS, joints_m=joints, kind="robot", prompt="")
    motion = Prediction.of(lifted_state(), action).motion()
    assert motion.held == ({0: 1} if down_m < 0.15 else {})
    lowered = [0, 0, -min(down_m, 0.15)]
    np.testing.assert_allclose(motion.paths[1].motion[-1, :3, 3], lowered, atol=0.006)
    np.testing.assert_allclose(motion.paths[1].motion[:, :3, :3], [np.eye(3)] * FRAMES)


def test_an_object_in_a_hand_has_the_support_that_it_was_taken_from():
    state = lifted_state()
    eye = CAMERAS.world_from_camera[0]
    scene = level_scene(state, eye, eye[None, :3, 3], reach_m=np.inf)
    assert scene.solids[1].lifted_m == pytest.approx(0.15)
    assert scene.plane(1) @ [0, 0, 0, 1] == pytest.approx(0, abs=1e-3)
    assert scene.solids[1].corners_m[:, 2].min() == pytest.approx(0.15, abs=1e-3)
