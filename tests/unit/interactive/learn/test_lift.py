"""The skill of lifting, in the tabletop world without rendering."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.interactive.env import ActionSpec
from egosim_jax.interactive.env.backends import tabletop_start
from egosim_jax.interactive.env.chunks import make_chunk
from egosim_jax.interactive.env.rewards import Outcome
from egosim_jax.interactive.learn.lift import MIDDLE_M, REACH_M, Lift
from egosim_jax.simulation.preview import VIDEO
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop import World, start_of_sequence
from tests.unit.interactive.learn.skill import walks

SEED, SPEC = 205, ActionSpec()


@pytest.fixture(scope="module")
def start():
    return tabletop_start(SEED, SPEC, VIDEO)


def action(start, offset_m=(0, 0.02, 0), closure=0.4):
    place = Lift().see(start.state)[:3] + np.array(offset_m) / REACH_M
    return np.array([*place, 2 * closure - 1, 0])


def rise(start, numbers):
    """Return the rise of the target in the true world."""
    rows = Lift().path(numbers, SPEC.rest, SPEC, frames=VIDEO.frames)
    moved = make_chunk(SPEC, rows, start=start, video=VIDEO).action
    scene = start_of_sequence(SEED, spec=VIDEO, kind="human")[0]
    _, after = World(scene=scene).move(moved)
    number = Lift().target(start.state)
    (name,) = (b.name for b in scene.bodies if scene.instance_id(b.name) == number)
    heights = [s.body(name).world_from_body[2, 3] for s in (scene, after.scene)]
    return heights[1] - heights[0]


def test_a_good_grasp_lifts_and_a_bad_one_does_not(start):
    assert rise(start, action(start)) > 0.05
    assert rise(start, action(start, closure=0.0)) < 0.01
    assert rise(start, action(start, offset_m=(0.1, 0.1, 0))) < 0.01


def test_the_target_is_small_and_near_the_resting_hand(start):
    state = start.state
    number = Lift().target(state)
    center = state.points_m[state.object_ids == number].mean(axis=0)
    assert Lift().see(state)[:3] * REACH_M + MIDDLE_M == pytest.approx(center, abs=1e-5)
    others = set(np.unique(state.object_ids)) - {0, number}
    hidden = np.where(state.object_ids == number, 0, state.object_ids).astype(np.int32)
    assert Lift().target(replace(state, object_ids=hidden)) in others
    bare = replace(state, object_ids=np.zeros_like(state.object_ids))
    with pytest.raises(InputError, match="no object of at most 11 cm"):
        Lift().target(bare)


@pytest.mark.parametrize(("risen_m", "reward", "success"), [(0.025, 0.5, False), (0.06, 1, True)])
def test_the_reward_is_the_rise(start, risen_m, reward, success):
    pose = np.eye(4)
    pose[2, 3] = risen_m
    after = replace(start.state, world_from_object={Lift().target(start.state): pose})
    envs = walks(1)
    envs.reset(seed=[SEED])
    envs.step(np.zeros((1, 1)))
    step = replace(envs.env.running[0].last, state=after)
    result = Lift()(Outcome(first=start.state, step=step))
    assert (result.reward, result.success) == (pytest.approx(reward), success)
    assert result.terminated


def test_other_rows_are_refused(start):
    spec = ActionSpec(layout="gripper")
    with pytest.raises(InputError, match="needs the wrist of one hand"):
        Lift().path(np.zeros(5), spec.rest, spec, frames=17)
