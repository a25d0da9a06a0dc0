"""Pushes of boxes of points by hands, and boxes that hands do not push."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.dynamics import predict
from egosim_jax.types import Action
from tests.scenes import state_of
from tests.unit.dynamics.test_possible_grips import BOX, CAMERAS, FRAMES, TABLE

CUBE, CASE, DRAWER = 0.03 * BOX, 0.08 * BOX, 0.03 * BOX * [2.4, 1, 1] + [0, -0.2, 0.01]


def state_with(*objects, **fields):
    """Return a state of objects on a table, with the ids from 1 on."""
    parts = [TABLE, *objects]
    ids = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return state_of(np.concatenate(parts), ids=ids, provenance={"world": "tabletop"}, **fields)


def gripper(path_m, *, opening_m):
    """Return the action of a gripper from above whose jaws are open along y, in each frame."""
    opening = np.broadcast_to(np.asarray(opening_m, float), FRAMES)[:, None] / 2
    jaws = [path_m + side * opening * [0, 1, 0] for side in (-1, 1)]
    joints = np.stack([path_m + [0, 0, 0.12], *jaws], axis=1)[:, None]
    return Action(cameras=CAMERAS, joints_m=joints, kind="robot", prompt="")


def along_x(first, last, *, z):
    """Return a straight path at a height."""
    x = np.linspace(first, last, FRAMES)
    return np.stack([x, np.zeros(FRAMES), np.full(FRAMES, z)], axis=1)


@pytest.mark.parametrize(("z", "pushed_m"), [(0.03, 0.1), (0.058, 0.0)], ids=["side", "rim"])
def test_a_closed_hand_pushes_from_the_side_and_glances_off_the_rim(z, pushed_m):
    motion = predict(state_with(CUBE), gripper(along_x(-0.136, 0.064, z=z), opening_m=0.002))
    moved = motion.paths[1].motion[-1, :3, 3] if pushed_m else np.zeros(3)
    assert pushed_m or not motion.paths
    np.testing.assert_allclose(moved, [pushed_m, 0, 0], atol=0.003)


def test_a_hand_that_rests_lets_in_what_another_one_brings():
    carries = gripper(along_x(0.0, 0.2, z=0.03), opening_m=[0.1, 0.08, *[0.06] * 15])
    rests = gripper(along_x(0.2, 0.2, z=0.02), opening_m=0.0)
    joints = np.concatenate([carries.joints_m, rests.joints_m], axis=1)
    motion = predict(state_with(CUBE), replace(carries, joints_m=joints))
    (cause,) = motion.paths[1].causes
    assert (cause.how, cause.hand) == ("held", 0)


def test_a_hand_around_an_object_may_leave_it_or_close_on_it():
    away = predict(state_with(CUBE), gripper(along_x(0.0, 0.2, z=0.03), opening_m=0.1))
    assert not away.paths
    closing = [0.1, 0.08, *[0.06] * 15]
    held = predict(state_with(CUBE), gripper(along_x(0.0, 0.2, z=0.03), opening_m=closing))
    assert held.held == {0: 1}


def test_an_open_drawer_is_a_part_of_its_case():
    """The drawer was pulled out by 14 cm: it does not touch its case, and shuts without a push."""
    out = np.eye(4)
    out[1, 3] = -0.14
    path = along_x(0, 0, z=0.04)
    path[:, 1] = np.linspace(-0.2, -0.08, FRAMES)
    shut = gripper(path, opening_m=[0.1, 0.09, *[0.06] * 15])
    apart = predict(state_with(CASE, DRAWER), shut)
    assert 1 in apart.paths
    state = state_with(CASE, DRAWER, world_from_object={2: out})
    assert 1 not in predict(state, shut).paths
