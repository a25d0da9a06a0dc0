"""Rows that are given part by part, while a clip is made."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from egosim_jax.interactive.env.parts import part_rows
from egosim_jax.interactive.env.single import WorldEnv
from egosim_jax.simulation.rig import MountedCamera
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.types import InputError
from tests import painted as painting
from tests.painted import VIDEO, ChunkPainter, PaintedWorld

WORLD = PaintedWorld(generator=ChunkPainter(), video=VIDEO, perception=None)


@pytest.fixture
def env():
    made = WorldEnv(WORLD)
    made.reset(seed=3)
    return made


def ahead(env, share=1.0):
    """Rows that move the hand away from the wearer."""
    return env.actions.rest + share * np.linspace(0, 0.1, 5)[1:, None] * np.eye(7)[1]


def test_parts_have_a_row_for_each_frame_but_the_first():
    assert part_rows((13, 16, 16, 16)) == (12, 16, 16, 16)
    assert part_rows((1, 8, 4)) == (8, 4)
    assert part_rows((61,)) == (60,)
    assert part_rows((1,)) == (0,)


def test_equal_rows_in_parts_and_at_once_give_equal_steps(env):
    assert env.parts == (2, 2)
    rows = ahead(env)
    found, reward, ended, truncated, info = env.part_step(rows[:2])
    assert (reward, ended, truncated, info["part"], info["chunk"]) == (0.0, False, False, 1, 0)
    assert 0 < info["timing"].first_frame_s <= info["timing"].last_frame_s
    np.testing.assert_array_equal(found["row"], rows[1])
    assert (found["frames"][3:] == found["frames"][2]).all()
    last, *_, done = env.part_step(rows[2:])
    whole = WorldEnv(WORLD)
    whole.reset(seed=3)
    want, *_, info = whole.chunk_step(rows)
    np.testing.assert_array_equal(last["frames"], want["frames"])
    np.testing.assert_array_equal(last["frames"][:3], found["frames"][:3])
    same = ("chunk", "state_sha256", "padded_frames", "hidden_hands", "notes", "validity")
    assert {name: done[name] for name in same} == {name: info[name] for name in same}
    assert done["part"] == 2
    assert 0 < info["timing"].first_frame_s <= info["timing"].last_frame_s


def test_a_short_part_is_padded_and_a_long_one_refused(env):
    with pytest.raises(InputError, match=r"must have 1 to 2 rows of 7 numbers"):
        env.part_step(ahead(env)[:3])
    held = env.part_step(ahead(env)[:1])[0]
    np.testing.assert_array_equal(held["row"], ahead(env)[0])
    assert env.part_step(ahead(env)[:1])[-1]["chunk"] == 1


def test_a_state_that_is_updated_by_chunk_sees_each_chunk_from_the_last_frame_on(env, monkeypatch):
    seen = []

    def perceive(self, clip, action, state):
        seen.append((len(clip.frames), len(action.joints_m), state.step))
        return SimpleNamespace(notes=(f"note {state.step}",))

    def fuse(self, state, perceived):
        return replace(state, step=state.step + 1)

    world = replace(WORLD, update_every="chunk", perception="classical")
    monkeypatch.setattr(Simulator, "perceive", perceive)
    monkeypatch.setattr(Simulator, "fuse", fuse)
    by_chunk = WorldEnv(world)
    by_chunk.reset(seed=3)
    info = by_chunk.chunk_step(ahead(env))[-1]
    assert seen == [(3, 3, 0), (3, 3, 1)]
    assert info["notes"] == ["note 0", "note 1"]
    assert by_chunk.running.now.state.step == 2


def test_further_cameras_show_each_part():
    wrist = MountedCamera(name="wrist", mount="right_wrist", pose=painting.WRIST)
    env = WorldEnv(WORLD, cameras=[wrist], observe=("frames", "wrist.frames"))
    env.reset(seed=3)
    rows = ahead(env)
    part, *_ = env.part_step(rows[:2])
    last, *_ = env.part_step(rows[2:])
    env.reset(seed=3)
    expected, *_ = env.chunk_step(rows)
    for name in ("frames", "wrist.frames"):
        np.testing.assert_array_equal(part[name][:3], expected[name][:3])
        np.testing.assert_array_equal(part[name][3:], expected[name][2:3].repeat(2, axis=0))
        np.testing.assert_array_equal(last[name], expected[name])
