"""PPO of a linear policy by public libraries, each through its adapter of our environment.

Both start at given weights, with normally distributed actions around them, and learn a
separate value. An episode is one step, so there is nothing to discount.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from gymnasium.vector import VectorEnv
from jaxtyping import Float

from egosim_jax.runtime.progress import track

Weights = Float[np.ndarray, "o1 a"]
"""Linear policy: the numbers of an action, from an observation and a 1."""
Library = Literal["stable_baselines3", "torchrl"]
SPREAD = 0.13
"""Standard deviation of the first actions, of numbers from -1 to 1."""
RATE, EPOCHS, HIDDEN = 1e-2, 10, 16
"""Learning rate, passes over each batch, and hidden units of the value."""


def by_stable_baselines3(
    envs: VectorEnv, weights: Weights, *, rounds: int, steps: int, seed: int
) -> Weights:
    """Return the weights after PPO of Stable-Baselines3: rounds of some steps of all episodes."""
    import torch
    from stable_baselines3 import PPO

    from egosim_jax.interactive.learn.stable_baselines import StableBaselinesEnv

    size = steps * envs.num_envs
    nets = {"pi": [], "vf": [HIDDEN]}
    model = PPO(
        "MlpPolicy",
        StableBaselinesEnv(envs),
        n_steps=steps,
        batch_size=size,
        n_epochs=EPOCHS,
        learning_rate=RATE,
        gamma=1.0,
        gae_lambda=1.0,
        policy_kwargs={"net_arch": nets, "log_std_init": float(np.log(SPREAD))},
        seed=seed,
        device="cpu",
    )
    last: Any = model.policy.action_net
    with torch.no_grad():
        last.weight.copy_(torch.as_tensor(weights[:-1].T))
        last.bias.copy_(torch.as_tensor(weights[-1]))
    model.learn(rounds * size)
    return np.concatenate([last.weight.detach().numpy().T, last.bias.detach().numpy()[None]])


def by_torchrl(envs: VectorEnv, weights: Weights, *, rounds: int, steps: int, seed: int) -> Weights:
    """Return the weights after PPO of TorchRL: rounds of some steps of all episodes."""
    import torch
    from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
    from torch import nn
    from torchrl.envs import ExplorationType, GymWrapper, set_exploration_type
    from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE

    torch.manual_seed(seed)
    world = GymWrapper(envs)
    world.set_seed(seed)
    linear = nn.Linear(len(weights) - 1, weights.shape[1])
    with torch.no_grad():
        linear.weight.copy_(torch.as_tensor(weights[:-1].T))
        linear.bias.copy_(torch.as_tensor(weights[-1]))
    spread = AddStateIndependentNormalScale(weights.shape[1])
    torch.nn.init.constant_(spread.state_independent_scale, np.log(np.expm1(SPREAD)))
    actor = ProbabilisticActor(
        TensorDictModule(nn.Sequential(linear, spread), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    units = nn.Linear(len(weights) - 1, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, 1)
    value = ValueOperator(nn.Sequential(*units))
    advantage = GAE(gamma=1.0, lmbda=1.0, value_network=value, average_gae=True)
    loss = ClipPPOLoss(actor, value, entropy_coeff=0.0)
    optimizer = torch.optim.Adam(loss.parameters(), lr=RATE)
    for _ in track(range(rounds), "PPO", total=rounds):
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            batch = world.rollout(steps, actor, break_when_any_done=False)
        for _ in range(EPOCHS):
            advantage(batch)
            losses = loss(batch)
            optimizer.zero_grad()
            (losses["loss_objective"] + losses["loss_critic"]).backward()
            optimizer.step()
    return np.concatenate([linear.weight.detach().numpy().T, linear.bias.detach().numpy()[None]])


LIBRARIES: dict[Library, Callable[..., Weights]] = {
    "stable_baselines3": by_stable_baselines3,
    "torchrl": by_torchrl,
}
"""Training by each library."""
