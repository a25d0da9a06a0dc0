"""Our environments in TorchRL itself, which wraps them as they are."""

import torch
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

from egosim_jax.interactive.env import make_vec
from tests.painted import painted
from tests.unit.interactive.learn.skill import walks


def test_the_specs_of_a_skill_and_of_rows_are_right():
    check_env_specs(GymWrapper(walks()))
    check_env_specs(GymWrapper(make_vec(num_envs=2, backend=painted(), observe=("keypoints",))))


def test_a_rollout_begins_ended_episodes_again():
    envs = GymWrapper(walks(max_chunks=2))
    assert envs.batch_size == torch.Size([2])
    data = envs.rollout(4, lambda seen: torch.ones(len(seen), 1), break_when_any_done=False)
    assert data["next", "reward"][..., 0].tolist() == [[1, 1, 1, 1]] * 2
    assert data["next", "truncated"][..., 0].tolist() == [[False, True, False, True]] * 2
    moved = data["next", "observation"][..., 0] - data["observation"][..., 0]
    assert torch.allclose(moved, torch.full((2, 4), 0.1), atol=1e-6)
    assert torch.allclose(data["observation"][:, 2, 0], data["observation"][:, 0, 0])
