"""Moves of the hand on the page."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import rotation_z
from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.play.moves import (
    Pose,
    drive,
    intent_of,
    perform,
    pre_grasp_pose,
    scene_from_state,
    suggest_goal,
)
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import World, start_of_sequence

VIDEO = VideoSpec(frames=17, height=24, width=40, fps=8)


@pytest.fixture(scope="module")
def scene():
    return start_of_sequence(0, spec=VIDEO)[0]


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_row_is_the_pose_that_it_was_made_of(side):
    spec = ActionSpec(sides=(side,), camera=True)
    pose = Pose.of_row(spec.rest, side)
    np.testing.assert_allclose(pose.row(side, np.zeros(6)), spec.rest, atol=1e-9)


def test_a_driven_hand_closes_when_it_is_there(scene):
    before = pre_grasp_pose(scene, "red box", "right")
    target = Pose(
        point_m=before.point_m + [0.1, 0, 0.05],
        rotation=rotation_z(0.5) @ before.rotation,
        closure=0.6,
    )
    path = drive(before, target, 17)
    assert len(path) == 16
    assert path[11].closure == before.closure
    np.testing.assert_allclose(path[11].point_m, target.point_m)
    np.testing.assert_allclose(path[-1].rotation, target.rotation, atol=1e-9)
    assert path[-1].closure == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("table", "side", "name", "place"),
    [
        (0, "right", "red box", (-0.05, 0.2)),
        (2, "left", "suggested", None),
        (3, "right", "suggested", None),
    ],
)
def test_the_true_world_puts_an_object_where_it_is_carried(table, side, name, place):
    """The hand starts at rest, below the tops of tall objects."""
    scene, camera, *_ = start_of_sequence(table, spec=VIDEO)
    spec = ActionSpec(sides=(side,), camera=True)
    before = Pose.of_row(spec.rest, side)
    if name == "suggested":
        name, place = suggest_goal(scene, side)
    intent = intent_of("carry", scene, name, np.array(place))
    words = f"picks up the {name} and puts it down to the"
    assert intent.caption.startswith(words)
    poses = [before, *perform(scene, intent, before, side, 17)]
    rows = np.clip([pose.row(side, np.zeros(6)) for pose in poses], *spec.bounds)
    action, _ = spec.to_action(rows, camera=camera, prompt=intent.caption)
    after = World(scene=scene).move(action)[1].scene.body(name)
    np.testing.assert_allclose(after.world_from_body[:2, 3], place, atol=0.01)


def test_the_state_remembers_where_an_object_was_put(scene):
    state = start_of_sequence(0, spec=VIDEO)[3]
    motion = np.eye(4)
    motion[:2, 3] = 0.1, -0.05
    number = scene.instance_id("red box")
    moved = scene_from_state(scene, replace(state, world_from_object={number: motion}))
    gap = moved.body("red box").world_from_body - scene.body("red box").world_from_body
    np.testing.assert_allclose(gap[:3, 3], [0.1, -0.05, 0])


def test_the_state_remembers_how_far_a_drawer_is_open():
    scene, _, _, state = start_of_sequence(1, spec=VIDEO)
    name = "green cabinet"
    opened = scene.with_opening(name, 0.75)
    motion = opened.first_part_pose(name) @ np.linalg.inv(scene.first_part_pose(name))
    state = replace(state, world_from_object={scene.instance_id(name): motion})
    assert scene_from_state(scene, state).openings[name] == pytest.approx(0.75)
    verb = intent_of("open or close", scene_from_state(scene, state), name).verb
    assert verb == "close"
