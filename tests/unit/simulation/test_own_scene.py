"""A scene of a user's own: a box that a hand pushes is where it was pushed in the next clip."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import transform
from egosim_jax.perception.registry import get
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.state.depth import state_from_depth
from egosim_jax.state.instances import find_objects
from tests.boxes import GREEN, RED, TABLE_FROM_CAMERA, cameras, cast, film, push

FRAMES = 13


@pytest.fixture(scope="module")
def pushed():
    """State before and after a clip with a push, the push, and a second clip of the state."""
    view = cameras(FRAMES)
    image, depth, ids = cast([RED, GREEN], view)
    found = find_objects(image, depth, view.intrinsics_px)
    red = int(np.bincount(found[ids == RED.number]).argmax())
    before = state_from_depth(image, depth, view.intrinsics_px, np.eye(4), object_ids=found)
    action, offsets = push(view)
    frames = film([RED, GREEN], action, {RED.number: offsets})
    simulator = Simulator(
        generator=lambda view, action, first_frame, seed: frames,
        perception=get("classical")().build(),
        fps=8,
    )
    after = simulator.step(before, action, seed=0).state
    still = replace(action, joints_m=np.full_like(action.joints_m, np.nan))
    second = replace(simulator, generator=lambda view, *rest: view.frames)
    return before, after, red, offsets[-1], second.step(after, still, seed=1).clip.frames


def center(state, number):
    points = state.points_m[state.object_ids == number].astype(float)
    return transform(TABLE_FROM_CAMERA, points).mean(axis=0)


def test_the_pushed_box_is_where_it_was_pushed_in_the_state(pushed):
    before, after, red, offset, _ = pushed
    moved = center(after, red) - center(before, red)
    assert np.linalg.norm(moved - offset) < 0.01, moved
    (other,) = set(before.object_ids.tolist()) - {0, red}
    kept = [np.unique(s.points_m[s.object_ids == other], axis=0) for s in (before, after)]
    np.testing.assert_array_equal(*kept)


def test_the_pushed_box_is_where_it_was_pushed_in_the_next_clip(pushed):
    *_, offset, frames = pushed
    view = cameras(FRAMES)
    corner = tuple(np.add(RED.corner_m, offset))
    _, _, ids = cast([replace(RED, corner_m=corner), GREEN], view)
    expected = ids == RED.number
    red, green, blue = frames[-1].astype(int).transpose(2, 0, 1)
    shown = (red > 1.6 * green) & (red > 1.6 * blue)
    assert (shown & expected).sum() / (shown | expected).sum() > 0.6
