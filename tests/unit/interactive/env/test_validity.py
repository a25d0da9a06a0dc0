"""Agreement of frames with the state, on a painted world of one background and two objects."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from egosim_jax.interactive.env.chunks import object_poses
from egosim_jax.interactive.env.validity import untouched, validity
from egosim_jax.rendering import reference
from egosim_jax.simulation.simulator import Step
from egosim_jax.types import Action, Cameras, Clip, SceneState, View

FRAMES, HEIGHT, WIDTH = 5, 48, 80
CONE, CUP = 10, 11


def scene():
    """State of a cone and a cup 30 cm apart, 0.5 m ahead."""
    place = {CONE: [-0.15, 0.0, 0.5], CUP: [0.15, 0.0, 0.5]}
    ids = np.repeat([CONE, CUP], 20).astype(np.int32)
    offsets = np.random.default_rng(0).uniform(-0.02, 0.02, (40, 3))
    points = np.array([place[n] for n in ids]) + offsets
    return SceneState(
        points_m=points.astype(np.float32),
        colors=np.zeros((40, 3), np.uint8),
        object_ids=ids,
        last_seen=np.zeros(40, np.int32),
        intrinsics_px=np.eye(3),
        names={CONE: "green cone", CUP: "red cup"},
    )


def view():
    """Gray background, the cone on the left and the cup on the right, at the top."""
    ids = np.zeros((FRAMES, HEIGHT, WIDTH), np.int32)
    ids[:, 4:14, 10:20], ids[:, 4:14, 60:70] = CONE, CUP
    frames = np.full((*ids.shape, 3), 120, np.uint8)
    frames[ids == CONE], frames[ids == CUP] = [30, 160, 40], [200, 40, 30]
    return View(
        frames=frames,
        mask=np.zeros(ids.shape, np.uint8),
        depth_m=np.full(ids.shape, 0.5, np.float32),
        object_ids=ids,
    )


def action(place=(0.0, 0.12, 0.4)):
    """A hand that rests low in the middle of the image."""
    hand = np.array([[0, 0, 0], *([0.01 * f, -0.01 * k, 0] for f in range(5) for k in range(4))])
    cameras = Cameras(
        world_from_camera=np.tile(np.eye(4), (FRAMES, 1, 1)),
        intrinsics_px=np.array([[70.0, 0, 39.5], [0, 70, 23.5], [0, 0, 1]]),
        height=HEIGHT,
        width=WIDTH,
    )
    joints = np.tile(hand + np.array(place), (FRAMES, 1, 1, 1))
    return Action(cameras=cameras, joints_m=joints, kind="human", prompt="")


def measured(frames, after=None, acted=None):
    state = scene()
    step = Step(view=view(), clip=Clip(frames=frames, fps=8), state=after or state)
    return validity(state, step, acted or action(), reference)


def test_a_faded_object_lowers_only_the_figure_of_objects():
    faded = view().frames.copy()
    faded[2:][view().object_ids[2:] == CONE] = 110
    found = measured(faded)
    assert found["validity"] == 1.0
    assert found["object_validity"] == pytest.approx(2 / 5)
    assert found["least_valid_object"] == CONE


def test_another_background_lowers_only_its_own_figure():
    frames = view().frames.copy()
    frames[view().object_ids == 0] += 60
    found = measured(frames)
    assert (found["validity"], found["object_validity"]) == (0.0, 1.0)


def test_softer_frames_of_an_object_agree_with_the_state():
    frames = np.stack([cv2.blur(frame, (3, 3)) for frame in view().frames])
    assert measured(frames)["object_validity"] == 1.0


def test_a_touched_object_may_look_as_it_will():
    frames = view().frames.copy()
    frames[view().object_ids == CONE] = 255
    assert measured(frames)["object_validity"] == 0.0
    pose = np.eye(4)
    pose[0, 3] = 0.05
    moved = replace(scene(), world_from_object={CONE: pose})
    assert measured(frames, after=moved)["object_validity"] == 1.0
    held = action(place=(-0.15, 0.06, 0.5)).joints_m
    assert untouched(scene(), scene(), held) == [CUP]
    assert untouched(scene(), scene(), np.full_like(held, np.nan)) == [CONE, CUP]


def test_poses_are_at_the_objects_and_turn_with_them():
    state = scene()
    poses = object_poses(state)
    assert poses.keys() == {CONE, CUP}
    np.testing.assert_allclose(poses[CUP][:3, 3], [0.15, 0, 0.5], atol=0.01)
    np.testing.assert_array_equal(poses[CUP][:3, :3], np.eye(3))
    turned = np.array([[0.0, -1, 0, 3], [1, 0, 0, 2], [0, 0, 1, 1], [0, 0, 0, 1]])
    pose = object_poses(replace(state, world_from_object={CUP: turned}))[CUP]
    np.testing.assert_array_equal(pose[:3, :3], turned[:3, :3])
    np.testing.assert_array_equal(pose[:3, 3], poses[CUP][:3, 3])
