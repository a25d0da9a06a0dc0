"""Flat vector environments: boxes, drawn scenes, and episodes that end."""

import numpy as np
import pytest

from egosim_jax.types import InputError
from tests.unit.interactive.learn.skill import walks


def test_actions_are_rows_of_the_skill_and_are_cut_off():
    envs = walks()
    before, _ = envs.reset(seed=[10, 11])
    after, reward, terminated, truncated, info = envs.step(np.array([[0.5], [9.0]]))
    assert after[:, 0] - before[:, 0] == pytest.approx([0.05, 0.1], abs=1e-6)
    assert after.dtype == np.float32
    assert after in envs.observation_space
    assert reward.tolist() == [1, 1]
    assert not (terminated | truncated).any()
    assert info["scene"].tolist() == [10, 11]
    envs.reset(seed=[10, 11])
    seen, *_ = envs.step(np.full((2, 1), -9.0))
    assert seen[:, 0] == pytest.approx([-0.03, -0.03])  # the bound of y


def test_scenes_are_drawn_by_the_seed_and_only_the_masked_are_new():
    envs = walks(3)
    first, info = envs.reset(seed=5)
    assert set(info["scene"]) <= set(range(10, 14))
    assert first[:, 1].tolist() == info["scene"].tolist()
    np.testing.assert_array_equal(envs.reset(seed=5)[0], first)
    envs.step(np.ones((3, 1)))
    mask = np.array([False, True, False])
    seen, after = envs.reset(options={"reset_mask": mask})
    assert (seen[:, 0] > first[:, 0] + 0.05).tolist() == [True, False, True]
    assert after["scene"][[0, 2]].tolist() == info["scene"][[0, 2]].tolist()


@pytest.mark.parametrize("actions", [np.zeros((2, 2)), np.full((2, 1), np.nan)])
def test_actions_that_are_none_are_refused_and_no_episode_changes(actions):
    envs = walks()
    envs.reset(seed=[10, 11])
    with pytest.raises(InputError, match="must be finite, of shape"):
        envs.step(actions)
    assert [running.chunks for running in envs.env.running] == [0, 0]


def test_bad_scenes_and_options_are_refused():
    with pytest.raises(InputError, match="scenes is empty"):
        walks(scenes=[])
    with pytest.raises(InputError, match="no reset option 'episode'"):
        walks().reset(options={"episode": "x"})
    with pytest.raises(InputError, match="3 seeds for 2 episodes"):
        walks().reset(seed=[1, 2, 3])
