"""Training of a denoiser for the few steps that its sampler takes.

A sampler of few steps hands its network inputs that ordinary training never has: from the second
step on, they contain the network's own prediction instead of the target. So most samples of
a batch are inputs of the sampler here. With its times t_1 > ... > t_n, a sample of step k begins
with noise and takes the k - 1 steps before it, without gradients:

    x_1 = e,   x_{k+1} = alpha(t_{k+1}) x0_k + sigma(t_{k+1}) e_k

where x0_k and e_k are the data and noise that the network predicts at x_k (Euler's step for a
rectified flow, DDIM's for a variance-preserving process). Its loss is the error of the prediction,

    | x0_k - x0 |^2 / sigma(t_k)^2

The other samples have noisy targets at random times, so that samplers of other steps still work;
there the same loss is the error of the velocity.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Key

from egosim_jax.conditioning import Condition
from egosim_jax.train.task import Batch, Metrics
from egosim_jax.train.tasks.denoising import Denoising, denoising, loss_weights
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class FewSteps(Denoising):
    """The task of training the denoiser for its sampler's steps."""

    others: float = 0.125
    """Fraction of a batch with noisy targets at random times."""

    def __post_init__(self) -> None:
        """Also raise `InputError` for students, predictions without a velocity, and shares."""
        super().__post_init__()
        if self.model.chunks is not None or self.model.process.prediction not in ("velocity", "v"):
            raise InputError(
                f"Training for a sampler's steps needs a model that denoises complete clips and "
                f"predicts velocities, not {self.model.name}."
            )
        if not 0 <= self.others < 1:
            raise InputError(f"others must be at least 0 and below 1, not {self.others}.")

    def loss(
        self, networks: Any, batch: Batch, keys: Key[Array, "b 2"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the loss of a batch under condition dropout, and the loss of each step.

        A sample's step is its place in the batch, so the order of samples must be random.
        """
        batch, condition = self.conditioned(networks, batch, keys)
        process, target = self.model.process, batch["target"].astype(jnp.float32)
        own = jax.vmap(jax.random.split)(keys[:, 1])
        noise = jax.vmap(lambda key: jax.random.normal(key, target.shape[1:]))(own[:, 1])
        times = process.times(self.model.visited)[:-1]
        bounds = self.bounds(len(target), len(times))
        random = self.objective.sample_times(process, own[: bounds[0], 0], bounds[0])
        steps = np.repeat(times, np.diff(bounds)).astype(np.float32)
        time = jnp.concatenate([random, jnp.asarray(steps)])
        level = time[:, None, None, None, None]
        alpha, sigma = process.alpha(level), process.sigma(level)
        noisy = process.add_noise(target, noise, level)[: bounds[0]]
        x = jnp.concatenate([noisy, *self.sampled(networks, condition, noise, times, bounds)])
        denoise = denoising(self.model, networks, condition, target)
        found = process.to_x0(x, denoise(x, process.timesteps(time)), alpha, sigma)
        weights = loss_weights(target, batch.get("prior", target), self.change_loss_weight)
        errors = (weights * jnp.square(found - target) / sigma**2).mean(axis=(1, 2, 3, 4))
        metrics = {
            f"loss_step_{number}": errors[start:end].mean()
            for number, (start, end) in enumerate(pairwise(bounds), start=1)
            if end > start
        }
        return errors.mean(), metrics

    def bounds(self, batch: int, steps: int) -> list[int]:
        """Return the first sample of each step in a batch, and the number of samples."""
        others = round(self.others * batch)
        return [others + round(n * (batch - others) / steps) for n in range(steps + 1)]

    def sampled(
        self,
        networks: Any,
        condition: Condition,
        noise: Float[Array, "b f h w c"],
        times: np.ndarray,
        bounds: list[int],
    ) -> list[Float[Array, "n f h w c"]]:
        """Return each step's inputs, sampled by the network without gradients."""
        graph, weights = nnx.split(networks)
        frozen = nnx.merge(graph, jax.lax.stop_gradient(weights))
        condition = jax.lax.stop_gradient(condition)
        process, x, inputs = self.model.process, noise[bounds[0] :], []
        for number, start in enumerate(bounds[1:-1], start=1):
            count = start - bounds[number - 1]
            inputs.append(x[:count])
            x = x[count:]
            if not len(x):  # a batch smaller than the number of steps
                return inputs
            rest = jax.tree.map(lambda array, start=start: array[start:], condition)
            denoise = denoising(self.model, frozen, rest, x)
            now, then = jnp.asarray(times[number - 1 : number + 1], jnp.float32)
            output = denoise(x, process.timesteps(jnp.full(len(x), now)))
            output = output.astype(jnp.float32)
            alpha, sigma = process.alpha(now), process.sigma(now)
            x0 = process.to_x0(x, output, alpha, sigma)
            epsilon = process.to_epsilon(x, output, alpha, sigma)
            x = process.add_noise(x0, epsilon, then)
        return [*inputs, x]
