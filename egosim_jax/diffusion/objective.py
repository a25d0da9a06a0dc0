"""What the denoiser is trained for: the velocity of the straight path, at random noise levels.

With the path of `schedule.py`, x_sigma = (1 - sigma) x0 + sigma e, one sample's error is

    L(sigma) = mean | v(x_sigma, 1000 sigma) - (e - x0) |^2

and the loss is E[w(sigma) L(sigma)] over e ~ N(0, 1) and one of these draws of sigma:

    uniform       u ~ U(0, 1),                         sigma = sigma(u),   w = 1
    logit-normal  u = 1 / (1 + exp(-z)), z ~ N(m, s),  sigma = sigma(u),   w = 1
                  (Esser et al. 2024, section 3.1)
    diffsynth     one of the 1000 levels of a 1000-step sampler, each as likely, weighted by a bell
                  around sigma = 1/2 that falls to 0 at the noisiest level:
                      w = (g - min g) / mean(g - min g),   g = exp(-2 (sigma - 1/2)^2),
                  minimum and mean over the 1000 levels (the training schedule of DiffSynth, on
                  which the EgoSim release is built)

where sigma(u) is the schedule's shift. The mean of L may give some places more weight than others.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from egosim_jax.diffusion.schedule import TIMESTEPS, FlowSchedule, VelocityFn
from egosim_jax.types import InputError


class Sampled(NamedTuple):
    """What was drawn for each sample of a batch, and how wrong the velocity was there."""

    sigma: Float[Array, " b"]
    error: Float[Array, " b"]
    """Mean squared error of the velocity, not weighted."""


@dataclass(frozen=True, kw_only=True)
class Objective:
    """Mean squared error of the velocity, and how noise levels are drawn and weighted."""

    schedule: FlowSchedule = field(default_factory=FlowSchedule)
    """The shift of the noise levels, and the rounding of timesteps."""
    times: Literal["uniform", "logit-normal", "diffsynth"] = "uniform"
    """How noise levels are drawn and weighted."""
    logit_mean: float = 0.0
    """Mean of the normal of `logit-normal`; above 0 prefers noisy samples."""
    logit_std: float = 1.0
    """Standard deviation of that normal."""

    def __post_init__(self) -> None:
        """Check the width of the logit-normal."""
        if not self.logit_std > 0:
            raise InputError(f"logit_std must be above 0, not {self.logit_std}.")

    def sample_sigma(self, key: Key[Array, " *keys"], batch: int) -> Float[Array, " b"]:
        """Draw a noise level for each sample; `key` is one key, or one for each sample."""
        keys = sample_keys(key, batch)
        if self.times == "diffsynth":
            levels = jnp.asarray(self._levels, jnp.float32)
            return levels[jax.vmap(lambda k: jax.random.randint(k, (), 0, TIMESTEPS))(keys)]
        if self.times == "uniform":
            return self.schedule.sigma(jax.vmap(jax.random.uniform)(keys))
        z = self.logit_mean + self.logit_std * jax.vmap(jax.random.normal)(keys)
        return self.schedule.sigma(jax.nn.sigmoid(z))

    def weight(self, sigma: Float[Array, " b"]) -> Float[Array, " b"]:
        """Weight of the error at these noise levels; 1 on average over the levels drawn."""
        if self.times != "diffsynth":
            return jnp.ones_like(sigma)
        bells = np.exp(-2 * (self._levels - 0.5) ** 2)
        floor = bells.min()
        return (jnp.exp(-2 * (sigma - 0.5) ** 2) - floor) / (bells - floor).mean()

    def loss(
        self,
        velocity_fn: VelocityFn,
        x0: Float[Array, "b f h w c"],
        key: Key[Array, " *keys"],
        *,
        places: Float[Array, "b f h w 1"] | float = 1.0,
    ) -> tuple[Float[Array, ""], Sampled]:
        """The weighted error at random noise levels, averaged over the batch.

        `key` is one key, or one for each sample: a sample's draws depend on its own key only, so
        a batch with given keys draws what its samples would draw alone. `places` weights the
        places of each sample, 1 on average.
        """
        keys = jax.vmap(jax.random.split)(sample_keys(key, x0.shape[0]))
        sigma = self.sample_sigma(keys[:, 0], x0.shape[0])
        noise = jax.vmap(lambda k: jax.random.normal(k, x0.shape[1:]))(keys[:, 1])
        error = self.loss_at(velocity_fn, x0, noise, sigma, places=places)
        return (self.weight(sigma) * error).mean(), Sampled(sigma, error)

    def loss_at(
        self,
        velocity_fn: VelocityFn,
        x0: Float[Array, "b f h w c"],
        noise: Float[Array, "b f h w c"],
        sigma: Float[Array, " b"],
        *,
        places: Float[Array, "b f h w 1"] | float = 1.0,
    ) -> Float[Array, " b"]:
        """Each sample's error at a given noise and noise level, in float32.

        Not weighted, but for the `places` of a sample.
        """
        x0, noise = x0.astype(jnp.float32), noise.astype(jnp.float32)
        level = sigma[:, None, None, None, None]
        velocity = velocity_fn((1 - level) * x0 + level * noise, self.schedule.timesteps(sigma))
        difference = velocity.astype(jnp.float32) - (noise - x0)
        return (places * jnp.square(difference)).mean(axis=(1, 2, 3, 4))

    @property
    def _levels(self) -> Float[np.ndarray, " levels"]:
        """The noise levels of DiffSynth's training: those of a sampler with 1000 steps."""
        return self.schedule.sigmas(TIMESTEPS)[:-1]


def sample_keys(key: Key[Array, " *keys"], batch: int) -> Key[Array, " b"]:
    """One key for each sample: `key` split, unless it already is one for each sample."""
    return key if key.ndim else jax.random.split(key, batch)
