"""Training of a denoiser for the few steps that its sampler takes.

A sampler of few steps hands its network inputs that ordinary training never has: from the second
step on, they contain the network's own prediction instead of the target. So most samples of
a batch are inputs of the sampler here. With its times t_1 > ... > t_n, a sample of step k begins
with noise and takes the k - 1 steps before it, as the model's solver does, without gradients. With
x0_k, the data that the network predicts there, its loss is the error of the prediction,

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
from egosim_jax.diffusion.solver import integrate
from egosim_jax.train.task import Batch, Metrics
from egosim_jax.train.tasks.denoising import Denoising, denoising, loss_weights
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class FewSteps(Denoising):
    """The task of training the denoiser for its sampler's steps."""

    others: float = 0.125
    """Fraction of a batch with noisy targets at random times."""

    def __post_init__(self) -> None:
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
        x = jnp.concatenate([noisy, *self.sampled(networks, condition, noise, bounds)])
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
        """Return the first sample of each step in a batch, and the number of samples.

        Raises `InputError` if there are fewer samples than steps: the objective would lack a step.
        """
        if batch < steps:
            raise InputError(
                f"Parts of a batch must have at least one sample for each of the sampler's {steps} "
                f"steps, not {batch}: raise --training.batch-size, or lower "
                "--training.grad-accum-steps. (batch_size)"
            )
        others = min(round(self.others * batch), batch - steps)
        return [others + round(n * (batch - others) / steps) for n in range(steps + 1)]

    def sampled(
        self,
        networks: Any,
        condition: Condition,
        noise: Float[Array, "b f h w c"],
        bounds: list[int],
    ) -> list[Float[Array, "n f h w c"]]:
        """Return each step's inputs, sampled by the network without gradients."""
        graph, weights = nnx.split(networks)
        frozen = nnx.merge(graph, jax.lax.stop_gradient(weights))
        condition = jax.lax.stop_gradient(condition)
        inputs = []
        for taken, (start, end) in enumerate(pairwise(bounds)):
            if end == start:  # a batch smaller than the number of steps
                continue
            own = jax.tree.map(lambda array, start=start, end=end: array[start:end], condition)
            x = integrate(
                denoising(self.model, frozen, own, noise[start:end]),
                noise[start:end],
                process=self.model.process,
                solver=self.model.solver,
                steps=self.model.visited,
                count=taken,
            )
            inputs.append(x)
        return inputs
