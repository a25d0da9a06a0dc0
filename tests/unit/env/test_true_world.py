"""The true tabletop world as an environment."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.env import ActionSpec, true_world
from egosim_jax.env.rewards import MoveObject
from egosim_jax.env.single import WorldEnv
from egosim_jax.env.true_world import TrueWorld
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import make_scripts
from egosim_jax.worlds.tabletop.policies import POLICIES

VIDEO = VideoSpec(frames=17, height=8, width=16, fps=8)
JOINTS = ActionSpec(
    layout="keypoints", workspace_m=((-0.6, -0.4, -0.1), (0.6, 0.8, 0.6)), sides=("right",)
)


def carry():
    """Seed, script, rows and task of a scene in which a body is carried."""
    for seed in range(20):
        script = next(make_scripts(seed, spec=VIDEO))
        if script.intent.verb == "carry":
            break
    joints = POLICIES[0].plan(script, np.random.default_rng(0))
    body = script.scene.body(script.intent.name)
    offset = script.intent.goal_m - body.world_from_body[:3, 3]
    number = script.scene.number(script.intent.name)
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


@pytest.mark.slow
def test_a_start_of_the_past_continues_to_the_same_state():
    seed, rows, _ = carry()
    world = TrueWorld(video=VIDEO)
    hashes = []
    for number in range(2):
        env = WorldEnv(world if number == 0 else TrueWorld(video=VIDEO), actions=JOINTS)
        if number == 0:
            env.reset(options={"start": replace(world.start(seed, JOINTS), row=rows[0])})
            env.chunk_step(rows[1:])
            middle = env.running.now
        else:
            env.reset(options={"start": middle})
        hashes.append(env.chunk_step(rows[::-1][:4])[-1]["state_sha256"])
    assert hashes[0] == hashes[1]


def test_the_worlds_that_were_used_last_are_kept(monkeypatch):
    monkeypatch.setattr(true_world, "REMEMBERED", 2)
    world = TrueWorld(video=VIDEO)
    starts = [world.start(seed, JOINTS) for seed in (1, 2, 3)]
    kept = world.after(starts[0], "human")
    for start in (starts[1], starts[0], starts[2]):
        world.after(start, "human")
    assert world.after(starts[0], "human") is kept
    assert len(world._worlds) == 2


def test_a_state_of_elsewhere_is_refused():
    world = TrueWorld(video=VIDEO)
    env = WorldEnv(world, actions=JOINTS)
    start = world.start(3, JOINTS)
    env.reset(options={"start": replace(start, state=replace(start.state, provenance={}))})
    with pytest.raises(InputError, match="true world has the scenes of its seeds"):
        env.chunk_step(JOINTS.rest[None])
