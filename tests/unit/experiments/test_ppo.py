"""PPO of a linear policy by both libraries, in a world of one number."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from egosim_jax.experiments.ppo import LIBRARIES


class Echo(VectorEnv):
    """An action earns a reward where it is near its observation; each episode is one step."""

    metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_modes": []}  # noqa: RUF012
    autoreset_mode = AutoresetMode.DISABLED
    num_envs = 16
    single_observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    single_action_space = spaces.Box(-1, 1, (1,), np.float32)
    observation_space = batch_space(single_observation_space, 16)
    action_space = batch_space(single_action_space, 16)
    random = np.random.default_rng(0)

    def reset(self, *, seed=None, options=None):
        self.seen = self.random.uniform(-0.8, 0.8, (16, 1)).astype(np.float32)
        return self.seen.copy(), {}

    def step(self, actions):
        near = np.abs(np.asarray(actions) - self.seen)[:, 0] < 0.2
        ended = np.ones(16, bool)
        return self.seen.copy(), near.astype(np.float32), ended, ~ended, {}


@pytest.mark.parametrize("library", LIBRARIES)
def test_ppo_improves_the_given_weights(library):
    torch.manual_seed(0)
    start = np.array([[0.7], [0.25]])
    same = LIBRARIES[library](Echo(), start, rounds=1, steps=1, seed=0)
    assert same == pytest.approx(start, abs=0.15)
    after = LIBRARIES[library](Echo(), start, rounds=20, steps=8, seed=0)
    seen = np.linspace(-0.8, 0.8, 50)
    hits = [np.abs(seen * w[0] + w[1] - seen) < 0.2 for w in (start, after)]
    assert hits[0].mean() < 0.5
    assert hits[1].mean() > 0.9
