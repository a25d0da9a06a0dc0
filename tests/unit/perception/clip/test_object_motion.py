"""Judgment of predicted motions by clips of red cubes on a table, drawn as points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import look_at
from egosim_jax.perception.clip.object_motion import TrackObjects
from egosim_jax.perception.pipeline import Observation
from egosim_jax.rendering.reference import render
from egosim_jax.types import Action, Clip
from tests.scenes import pinhole, state_of

FRAMES = 13
CAMERA = look_at(np.array([0, -0.35, 0.4]), np.array([0, 0, 0.0]), up=np.array([0, 0, 1.0]))
CAMERAS = pinhole([CAMERA] * FRAMES, 120.0, 96, 160)
OPENING = np.array([0.08, 0.08, 0.06] + [0.04] * (FRAMES - 3))
"""Opening of a gripper that closes on a cube of 4 cm in the fourth frame."""
SIDE = np.arange(-0.3, 0.3, 0.004)
TABLE = np.stack(np.meshgrid(SIDE, SIDE, [0.0]), axis=-1).reshape(-1, 3)
EDGE = np.linspace(-0.02, 0.02, 11)
CUBE = np.stack(np.meshgrid(EDGE, EDGE, EDGE + 0.02), axis=-1).reshape(-1, 3)


def make_state(*places):
    """Return a state with cubes, with the ids 1, 2, ..., at places on a table."""
    cubes = [CUBE + [x, y, 0] for x, y in places]
    points = np.concatenate([TABLE, *cubes])
    ids = np.repeat(np.arange(len(cubes) + 1), [len(TABLE), *(len(CUBE) for _ in cubes)])
    red = np.array([200, 30, 30]) + np.arange(len(points))[:, None] % 2 * [0, 20, 40]
    return state_of(
        points,
        colors=np.where(ids[:, None] > 0, red, [150, 140, 120]),
        ids=ids,
        names={number + 1: f"red cube {number + 1}" for number in range(len(cubes))},
        provenance={"world": "tabletop"},
    )


def gripper(path_m, opening_m=OPENING):
    """Return the joints of a gripper whose pinch point is on a path, above it."""
    path = np.asarray(path_m, float)
    across = np.asarray(opening_m)[:, None] / 2 * [1, 0, 0]
    return np.stack([path + [0, 0, 0.12], path - across, path + across], axis=1)


def carry(place, end):
    """Return a path that waits at a cube until the gripper has closed, and then goes to an end."""
    share = np.clip((np.arange(FRAMES) - 3) / (FRAMES - 4), 0, 1)[:, None]
    start = np.array([*place, 0.02])
    return start + share * (np.array(end) - start)


def film(state, shifts=None):
    """Return the clip of a state whose objects are shifted in each frame."""
    frames = []
    for frame in range(FRAMES):
        points = state.points_m.copy()
        for number, path in (shifts or {}).items():
            points[state.object_ids == number] += path[frame].astype(np.float32)
        one = replace(CAMERAS, world_from_camera=CAMERA[None])
        frames.append(render(replace(state, points_m=points), one, point_px=2).frames[0])
    return np.stack(frames)


def track(state, hands, frames):
    """Return what `TrackObjects` observes; the pixels of the grippers are not hidden."""
    action = Action(cameras=CAMERAS, joints_m=np.stack(hands, axis=1), kind="robot", prompt="")
    seen = Observation(
        cameras=CAMERAS,
        joints_m=action.joints_m,
        object_ids=np.zeros(frames.shape[:3], np.int32),
        names={},
    )
    return TrackObjects()(Clip(frames=frames, fps=8), action, state, seen)


def end_of(observed, number):
    return observed.motions[number][-1, :3, 3]


@pytest.mark.parametrize("shown", ["the carry", "gray", "rest"])
def test_a_sure_grip_carries_an_object_whatever_the_clip_shows(shown):
    state, path = make_state((0, 0)), carry((0, 0), (0.1, 0.02, 0.06))
    frames = film(state, {1: path - path[0]} if shown == "the carry" else None)
    frames = np.full_like(frames, 127) if shown == "gray" else frames
    observed = track(state, [gripper(path)], frames)
    np.testing.assert_allclose(end_of(observed, 1), path[-1] - path[0], atol=0.004)
    assert observed.held == {0: 1}
    notes = ("the gripper carried red cube 1, as predicted, but the clip shows it at rest",)
    assert observed.notes == (notes if shown == "rest" else ())


def test_two_grippers_carry_two_objects():
    places = (-0.1, 0), (0.1, 0)
    state = make_state(*places)
    paths = [carry(place, (place[0], 0.05, 0.06)) for place in places]
    shifts = {number + 1: path - path[0] for number, path in enumerate(paths)}
    observed = track(state, [gripper(path) for path in paths], film(state, shifts))
    assert observed.held == {0: 1, 1: 2}
    for number, shift in shifts.items():
        np.testing.assert_allclose(end_of(observed, number), shift[-1], atol=0.004)


@pytest.mark.parametrize("moves", [True, False])
def test_a_gripper_that_was_closed_before_holds_what_the_clip_shows_in_it(moves):
    state, path = make_state((0, 0)), carry((0, 0), (0, 0, 0.1))
    frames = film(state, {1: path - path[0]} if moves else None)
    path[:4, 2] += [0.12, 0.08, 0.04, 0]
    observed = track(state, [gripper(path, np.full(FRAMES, 0.036))], frames)
    assert set(observed.motions) == ({1} if moves else set())
    if moves:
        np.testing.assert_allclose(end_of(observed, 1), path[-1] - path[3], atol=0.006)
        assert observed.notes[0].startswith("the gripper may have held red cube 1")


@pytest.mark.parametrize(("moves", "count"), [(True, 1), (False, 0)])
def test_a_clip_refutes_a_short_push(moves, count):
    state = make_state((0, 0))
    path = np.linspace([-0.08, 0, 0.02], [-0.005, 0, 0.02], FRAMES)
    push = np.maximum(path + [0.02, 0, -0.02], 0)
    joints = gripper(path, np.zeros(FRAMES))
    observed = track(state, [joints], film(state, {1: push} if moves else None))
    assert len(observed.motions) == count
    note = "the gripper pushed red cube 1, as predicted, but the clip shows it at rest: it stays"
    assert observed.notes == (() if moves else (note,))


def test_an_object_without_an_id_gets_one_when_a_gripper_takes_it():
    state, path = make_state((0, 0)), carry((0, 0), (0.1, 0.02, 0.06))
    bare = replace(state, object_ids=np.zeros_like(state.object_ids), names={})
    observed = track(bare, [gripper(path)], film(state, {1: path - path[0]}))
    assert set(observed.new_objects) == {1}
    assert len(observed.new_objects[1]) > 0.9 * len(CUBE)
    np.testing.assert_allclose(end_of(observed, 1), path[-1] - path[0], atol=0.006)
