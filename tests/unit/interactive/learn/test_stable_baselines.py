"""Our environments in Stable-Baselines3 itself."""

import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from egosim_jax.interactive.env import make_vec
from egosim_jax.interactive.learn.stable_baselines import StableBaselinesEnv
from egosim_jax.types import InputError
from tests.painted import painted
from tests.unit.interactive.learn.skill import walks


def test_an_ended_episode_begins_again_and_keeps_its_last_observation():
    env = StableBaselinesEnv(walks(max_chunks=2))
    env.seed(0)
    first = env.reset()
    env.step(np.ones((2, 1)))
    seen, rewards, done, infos = env.step(np.ones((2, 1)))
    assert rewards.tolist() == [1, 1]
    assert done.all()
    last = np.stack([info["terminal_observation"] for info in infos])
    assert last[:, 0] == pytest.approx(first[:, 0] + 0.2, abs=1e-6)
    assert seen[:, 0] == pytest.approx(first[:, 0], abs=1e-6)
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert [env.reset_infos[n]["scene"] for n in (0, 1)] == seen[:, 1].tolist()
    assert infos[0]["object_poses"].keys() == infos[0]["objects"].keys()
    assert infos[0]["chunk"] == 2


def test_success_is_no_time_limit():
    env = StableBaselinesEnv(walks(ends=True))
    env.reset()
    _, _, done, infos = env.step(np.zeros((2, 1)))
    assert done.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, False]
    assert all(info["success"] for info in infos)


def test_ppo_learns_from_a_skill_and_from_rows():
    torch.manual_seed(0)
    env = VecMonitor(StableBaselinesEnv(walks(ends=True)))
    model = PPO("MlpPolicy", env, n_steps=2, batch_size=4, n_epochs=1, seed=0).learn(8)
    assert model.num_timesteps == 8
    assert {entry["r"] for entry in model.ep_info_buffer} == {1.0}
    rows = StableBaselinesEnv(make_vec(num_envs=2, backend=painted(), observe=("keypoints",)))
    PPO("MultiInputPolicy", rows, n_steps=1, batch_size=2, n_epochs=1, seed=0)


def test_nested_observations_and_other_resets_are_refused():
    nested = make_vec(num_envs=1, backend=painted(), observe=("state",))
    with pytest.raises(InputError, match="'state' is a Dict"):
        StableBaselinesEnv(nested)
    with pytest.raises(InputError, match="resets by itself"):
        StableBaselinesEnv(SyncVectorEnv([lambda: __import__("gymnasium").make("CartPole-v1")]))
