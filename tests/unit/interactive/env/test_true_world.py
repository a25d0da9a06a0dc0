"""The true tabletop world as an environment."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.interactive.env import ActionSpec, Start
from egosim_jax.interactive.env.chunks import make_chunk
from egosim_jax.interactive.env.rewards import MoveObject
from egosim_jax.interactive.env.single import WorldEnv
from egosim_jax.interactive.env.true_world import TrueWorld
from egosim_jax.simulation.actions import FullAction
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import make_scripts
from egosim_jax.worlds.tabletop.policies import POLICIES

VIDEO = VideoSpec(frames=17, height=8, width=16, fps=8)
JOINTS = ActionSpec(
    layout="keypoints", workspace_m=((-0.6, -0.4, -0.1), (0.6, 0.8, 0.6)), sides=("right",)
)
WIDE = replace(JOINTS, workspace_m=((-2.0, -2.0, -1.0), (2.0, 2.0, 2.0)))


@functools.cache
def carry():
    """Seed, rows and task of a scene with a carry script."""
    for seed in range(20):
        script = next(make_scripts(seed, spec=VIDEO))
        if script.intent.verb == "carry":
            break
    joints = POLICIES[0].plan(script, np.random.default_rng(0))
    body = script.scene.body(script.intent.name)
    offset = script.intent.goal_m - body.world_from_body[:3, 3]
    number = script.scene.instance_id(script.intent.name)
    return seed, joints.reshape(VIDEO.frames, -1), MoveObject(number=number, offset_m=tuple(offset))


def test_an_exact_policy_succeeds_exactly_and_a_resting_one_does_not():
    seed, rows, task = carry()
    world = TrueWorld(video=VIDEO)
    env = WorldEnv(world, actions=JOINTS, reward=task)
    start = replace(world.start(seed, JOINTS), row=rows[0])
    env.reset(options={"start": start})
    _, reward, terminated, _, info = env.chunk_step(rows[1:])
    assert (terminated, info["success"]) == (True, True)
    assert reward > -0.005  # the true world lets it down where the hand opens
    env.reset(options={"start": start})
    _, reward, terminated, _, info = env.chunk_step(rows[:1])
    assert not info["success"]
    assert reward == pytest.approx(-np.linalg.norm(task.offset_m))


def follow(start, *paths):
    """Start after some chunks, and the last chunk, without rendering."""
    for rows in paths:
        chunk = make_chunk(WIDE, rows, start=start, video=VIDEO)
        start = start.after(start.state, chunk.rows[-1], chunk.action)
    return start, chunk


def taken():
    """Start, rows that grasp a body, rows that carry it out of view, and task."""
    seed, rows, task = carry()
    start = replace(TrueWorld(video=VIDEO).start(seed, WIDE), row=rows[0])
    behind = (rows[9].reshape(-1, 3) + [0, -0.9, 0.2]).ravel()
    out = rows[9] + np.linspace(0, 1, 17)[1:, None] * (behind - rows[9])
    return start, rows, out, task


def test_a_hand_out_of_view_still_holds_its_body(tmp_path):
    start, rows, out, _ = taken()
    world = TrueWorld(video=VIDEO)
    now, _ = follow(start, rows[1:10])
    (held,) = world.after(now, "human").grasps
    away, chunk = follow(now, out, out[-1:])
    assert chunk.hidden.all()
    assert np.isnan(chunk.action.joints_m).all()
    away.save(tmp_path / "start")
    for found in (away, Start.load(tmp_path / "start")):
        back, _ = follow(found, out[::-1])
        (kept,) = TrueWorld(video=VIDEO).after(back, "human").grasps
        assert kept.name == held.name
        np.testing.assert_array_equal(kept.part_from_hand, held.part_from_hand)


def test_only_hands_out_of_view_have_places_in_a_start(tmp_path):
    start, _, out, _ = taken()
    away, _ = follow(start, out, out[-1:])
    away.save(tmp_path / "start")
    past = tmp_path / "start" / "past"
    assert sorted(p.name for p in past.iterdir()) == ["1.npz", "2.npz", "2_hands.npz"]
    found = Start.load(tmp_path / "start").past
    assert [isinstance(action, FullAction) for action in found] == [False, True]
    assert np.isnan(found[1].joints_m).all()


def test_a_state_of_elsewhere_is_refused():
    world = TrueWorld(video=VIDEO)
    env = WorldEnv(world, actions=JOINTS)
    start = world.start(3, JOINTS)
    env.reset(options={"start": replace(start, state=replace(start.state, provenance={}))})
    with pytest.raises(InputError, match="true world has only the scenes of its seeds"):
        env.chunk_step(JOINTS.rest[None])
