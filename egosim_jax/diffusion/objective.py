"""The training objective: the squared error of the network's prediction at random noise levels.

With a process of `process.py`, x_t = alpha(t) x0 + sigma(t) e, one sample's error is

    L(t) = mean | f(x_t, timestep(t)) - target |^2

The target is the quantity that the network predicts, such as e - x0 for a velocity. The loss is
E[w(t) L(t)] over e ~ N(0, 1) and one of these draws of the time t:

    uniform       u ~ U(0, 1),                         t = t(u),   w = 1
    logit-normal  u = 1 / (1 + exp(-z)), z ~ N(m, s),  t = t(u),   w = 1
                  (Esser et al. 2024, section 3.1)
    diffsynth     one of the 1000 times of a 1000-step sampler, each as likely, weighted by a bell
                  around t = 1/2 that falls to 0 at the noisiest time:
                      w = (g - min g) / mean(g - min g),   g = exp(-2 (t - 1/2)^2),
                  minimum and mean over the 1000 times (the training schedule of DiffSynth, on
                  which the EgoSim release is built)

With `sampler_steps` n, every second sample instead takes one of the n times that a sampler of n
steps visits. A model that is used with few steps learns these levels best.

Here t(u) is the process's `warp`, the shift of a rectified flow. The mean of L may weight the
locations of a sample. Elements whose |f - target| exceeds a bound may count as 0 (DWM-Wan's
trainer, at 50), so one corrupt value does not spoil an update.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from egosim_jax.diffusion.process import TIMESTEPS, DenoiseFn, Process
from egosim_jax.types import InputError, check_counts


class Sampled(NamedTuple):
    """Time and error of each sample of a batch, or of each of its frames."""

    time: Float[Array, " *times"]
    error: Float[Array, " *times"]
    """Mean squared error of the prediction, not weighted by the time."""


@dataclass(frozen=True, kw_only=True)
class Objective:
    """Mean squared error of the prediction, with the distribution and weights of noise levels.

    The process is the model's: every method takes it.
    """

    times: Literal["uniform", "logit-normal", "diffsynth"] = "uniform"
    """Distribution and weights of the times."""
    logit_mean: float = 0.0
    """Mean of the normal of `logit-normal`; above 0 prefers noisy samples."""
    logit_std: float = 1.0
    """Standard deviation of that normal."""
    sampler_steps: int | None = None
    """Number of steps of the sampler whose times half of the samples take; None: no sample."""
    max_difference: float | None = None
    """Difference from the target above which an element's error counts as 0; None: no limit."""

    def __post_init__(self) -> None:
        check_counts({"sampler_steps": self.sampler_steps})
        if self.sampler_steps is not None and self.times == "diffsynth":
            raise InputError(
                f"The weights of diffsynth fit its own times only: omit sampler_steps, instead of "
                f"{self.sampler_steps}. (sampler_steps)"
            )
        if not self.logit_std > 0:
            raise InputError(f"logit_std must be above 0, not {self.logit_std}.")
        if self.max_difference is not None and not self.max_difference > 0:
            raise InputError(
                f"max_difference must be above 0, not {self.max_difference}: at 0 nothing would be "
                "learned. Omit it, or give DWM-Wan's 50. (--max-difference)"
            )

    def sample_times(
        self, process: Process, key: Key[Array, " *keys"], batch: int
    ) -> Float[Array, " b"]:
        """Draw a time for each sample; `key` is one key, or one for each sample."""
        keys = sample_keys(key, batch)
        if self.sampler_steps is not None:
            visited = jnp.asarray(process.times(self.sampler_steps)[:-1], jnp.float32)
            own = jax.vmap(jax.random.split)(keys)
            step = jax.vmap(lambda k: jax.random.randint(k, (), 0, 2 * len(visited)))(own[:, 1])
            others = replace(self, sampler_steps=None).sample_times(process, own[:, 0], batch)
            return jnp.where(step < len(visited), visited[step % len(visited)], others)
        if self.times == "diffsynth":
            times = jnp.asarray(process.times(TIMESTEPS)[:-1], jnp.float32)
            return times[jax.vmap(lambda k: jax.random.randint(k, (), 0, TIMESTEPS))(keys)]
        if self.times == "uniform":
            return process.warp(jax.vmap(jax.random.uniform)(keys))
        z = self.logit_mean + self.logit_std * jax.vmap(jax.random.normal)(keys)
        return process.warp(jax.nn.sigmoid(z))

    def weight(self, process: Process, time: Float[Array, " *times"]) -> Float[Array, " *times"]:
        """Return the weight of the error at these times; 1 on average over the times drawn."""
        if self.times != "diffsynth":
            return jnp.ones_like(time)
        bells = np.exp(-2 * (process.times(TIMESTEPS)[:-1] - 0.5) ** 2)
        floor = bells.min()
        return (jnp.exp(-2 * (time - 0.5) ** 2) - floor) / (bells - floor).mean()

    def loss(
        self,
        process: Process,
        denoise: DenoiseFn,
        x0: Float[Array, "b f h w c"],
        key: Key[Array, " *keys"],
        *,
        loss_weights: Float[Array, "b f h w 1"] | float = 1.0,
        chunks: Sequence[int] | None = None,
    ) -> tuple[Float[Array, ""], Sampled]:
        """Return the weighted error at random times, averaged over the batch.

        `key` is one key, or one for each sample. A sample's draws depend only on its own key, not
        on the batch. `loss_weights` weights the locations of each sample, 1 on average. With
        `chunks`, numbers of frames, each chunk of a sample has its own time, and each frame a time
        and an error.
        """
        keys = jax.vmap(jax.random.split)(sample_keys(key, x0.shape[0]))
        if chunks is None:
            time = self.sample_times(process, keys[:, 0], x0.shape[0])
        else:
            own = jax.vmap(lambda k: jax.random.split(k, len(chunks)))(keys[:, 0])
            drawn = [
                jnp.tile(self.sample_times(process, own[:, n], len(x0))[:, None], (1, frames))
                for n, frames in enumerate(chunks)
            ]
            time = jnp.concatenate(drawn, axis=1)
        noise = jax.vmap(lambda k: jax.random.normal(k, x0.shape[1:]))(keys[:, 1])
        error = self.loss_at(process, denoise, x0, noise, time, loss_weights=loss_weights)
        return (self.weight(process, time) * error).mean(), Sampled(time, error)

    def loss_at(
        self,
        process: Process,
        denoise: DenoiseFn,
        x0: Float[Array, "b f h w c"],
        noise: Float[Array, "b f h w c"],
        time: Float[Array, " *times"],
        *,
        loss_weights: Float[Array, "b f h w 1"] | float = 1.0,
    ) -> Float[Array, " *times"]:
        """Return each sample's error at a given noise and time, in float32.

        The error is weighted over locations, not by time. With a time for each frame, it is each
        frame's.
        """
        x0, noise = x0.astype(jnp.float32), noise.astype(jnp.float32)
        level = jnp.expand_dims(time, tuple(range(time.ndim, x0.ndim)))
        output = denoise(process.add_noise(x0, noise, level), process.timesteps(time))
        difference = output.astype(jnp.float32) - process.target(x0, noise, level)
        if self.max_difference is not None:
            difference = jnp.where(jnp.abs(difference) <= self.max_difference, difference, 0)
        errors = loss_weights * jnp.square(difference)
        return errors.mean(axis=tuple(range(time.ndim, x0.ndim)))


def sample_keys(key: Key[Array, " *keys"], batch: int) -> Key[Array, " b"]:
    """Return one key for each sample; a single `key` is split."""
    return key if key.ndim else jax.random.split(key, batch)
