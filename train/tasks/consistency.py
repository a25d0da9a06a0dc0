"""Causal consistency distillation: a student predicts the data at any noise level in one step.

A sampler of `points` steps visits the times. For a drawn time t and the next one, s, the
teacher takes the sampler's step from x_t to x_s. The student's prediction of the data at x_t
learns to equal the prediction at x_s by the moving average of the weights:

    mean w | f(x_t, t) - f_average(x_s, s) |^2,    f(x, 0) = x

Teacher and student are causal: each chunk sees the clean chunks of the recorded clip before it, and
has its own time. w weights the locations (`denoising.loss_weights`).

Sources: Song et al. 2023 (section 5.1); Causal Forcing++ for the causal form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from egosim_jax.generation.causal import chunks_of
from egosim_jax.train.task import Batch, Metrics, Roles
from egosim_jax.train.tasks.denoising import Denoising, condition_of, denoising, loss_weights
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class Consistency(Denoising):
    """The task of distilling a causal denoiser of many steps into one of few."""

    points: int = 48
    """Number of steps of the teacher's sampler."""

    @property
    def critic(self) -> None:
        """None: there is no critic."""

    def __post_init__(self) -> None:
        super().__post_init__()
        chunks_of(self.model)
        if self.points < 2:
            raise InputError(
                f"The teacher's sampler needs at least 2 steps, not {self.points}. (--points)"
            )

    def loss(
        self, networks: Any, batch: Batch, keys: Key[Array, "b 2"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the weighted squared distance of the predictions."""
        roles: Roles = networks
        condition = self.dropout.apply(condition_of(roles.student, batch, self.model), keys[:, 0])
        target, process = batch["target"], self.model.process
        weights = loss_weights(target, batch.get("prior", target), self.change_loss_weight)
        own = jax.vmap(jax.random.split)(keys[:, 1])
        noise = jax.vmap(lambda key: jax.random.normal(key, target.shape[1:]))(own[:, 0])
        now, after = self._times(own[:, 1])

        noisy = process.add_noise(target, noise, _level(now))
        student, average, teacher = (
            denoising(self.model, part, condition, target)
            for part in (roles.student, roles.average, roles.teacher)
        )
        guided = teacher(noisy, process.timesteps(now)).astype(jnp.float32)
        scales = process.alpha(_level(now)), process.sigma(_level(now))
        less = process.alpha(_level(after)) * process.to_x0(noisy, guided, *scales)
        less += process.sigma(_level(after)) * process.to_epsilon(noisy, guided, *scales)
        wanted = process.to_x0(
            less,
            average(less, process.timesteps(after)).astype(jnp.float32),
            process.alpha(_level(after)),
            process.sigma(_level(after)),
        )
        wanted = jnp.where(_level(after) > 0, wanted, less)
        found = student(noisy, process.timesteps(now)).astype(jnp.float32)
        found = process.to_x0(noisy, found, *scales)
        error = weights * jnp.square(found - jax.lax.stop_gradient(wanted))
        return error.mean(), {}

    def flops(self, samples: int) -> float:
        """Return the model FLOPs of an update: the denoiser's, and two passes without gradient."""
        return super().flops(samples) + 2 * samples * self.forward().total

    def _times(self, keys: Key[Array, " b"]) -> tuple[Float[Array, "b f"], Float[Array, "b f"]]:
        """Draw a time of each chunk, and the next one of the sampler, for each latent frame."""
        chunks = chunks_of(self.model)
        count = len(chunks.sizes)
        steps = jax.vmap(lambda key: jax.random.randint(key, (count,), 0, self.points))(keys)
        steps = jnp.repeat(steps, np.array(chunks.sizes), axis=1)
        times = jnp.asarray(self.model.process.times(self.points), jnp.float32)
        return times[steps], times[steps + 1]


def _level(time: Float[Array, "b f"]) -> Float[Array, "b f 1 1 1"]:
    return time[..., None, None, None]
