"""A skill without objects, and environments of it in a painted world."""

from dataclasses import dataclass

import numpy as np

from egosim_jax.interactive.env import make_vec
from egosim_jax.interactive.env.rewards import Reward
from egosim_jax.interactive.learn.flat import FlatVectorEnv
from tests.painted import painted


@dataclass(frozen=True)
class Walk:
    """The hand walks along y; each chunk has a reward of 1."""

    ends: bool = False
    observed = 2
    acted = 1

    def observe(self, running):
        return np.array([running.row[1], running.start.seed])

    def rows(self, action, running):
        return running.row + np.linspace(0, 0.1 * action[0], 3)[1:, None] * np.eye(7)[1]

    def __call__(self, outcome):
        return Reward(reward=1.0, terminated=self.ends, success=self.ends)


def walks(number=2, *, ends=False, max_chunks=2, scenes=range(10, 14)):
    envs = make_vec(
        num_envs=number,
        backend=painted(),
        observe=(),
        reward=Walk(ends),
        max_chunks=max_chunks,
    )
    return FlatVectorEnv(envs, Walk(ends), scenes=scenes)
