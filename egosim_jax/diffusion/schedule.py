"""The straight path from data to noise, and where a sampler stops on it.

Flow matching (Lipman et al. 2023; rectified flow, Liu et al. 2023) joins a latent x0 to Gaussian
noise e by a straight line, which a network learns to walk:

    x_sigma = (1 - sigma) x0 + sigma e,     sigma in [0, 1]
    dx/dsigma = v = e - x0                  the velocity, the network's target

Large latents need more of their time at high noise, so a uniform position u is warped by the shift
s (the resolution-dependent shift of Esser et al. 2024; s = 5 in the EgoSim release):

    sigma(u) = s w / (1 + (s - 1) w),       w = sigma_min + (sigma_max - sigma_min) u

A sampler of N steps stops at u = 1, 1 - 1/N, ..., 1/N and ends at sigma = 0. The network is told
t = 1000 sigma.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeVar

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
from jaxtyping import Array, Float

from egosim_jax.types import InputError

TIMESTEPS = 1000
"""The network's timestep at sigma = 1."""

VelocityFn = Callable[
    [Float[Array, "b f h w c"], Float[Array, " b"]],
    Float[Array, "b f h w c"],
]
"""`velocity(x, t)`: noisy latents and their timesteps 1000 sigma to the velocity dx/dsigma."""

Numbers = TypeVar("Numbers", np.ndarray, jax.Array)


@dataclass(frozen=True, kw_only=True)
class FlowSchedule:
    """Noise levels: their shift, their range, and how the network is told of them."""

    shift: float = 5.0
    """How far the levels are pushed towards noise; 1 leaves them evenly spaced."""
    sigma_min: float = 0.0
    """Lower end of the range that is warped and divided into steps."""
    sigma_max: float = 1.0
    """Upper end of that range: the first noise level, before the shift."""
    timestep_rounding: Literal["none", "bfloat16", "down"] = "none"
    """`bfloat16` rounds t before it is embedded (spacing 4 above 512), as the EgoSim release;
    `down` takes the whole number below, as Wan's own UniPC."""

    def __post_init__(self) -> None:
        """Check the shift and the range."""
        if not self.shift > 0:
            raise InputError(f"shift must be above 0, not {self.shift}; 1 means no shift.")
        if not 0 <= self.sigma_min < self.sigma_max <= 1:
            raise InputError(
                "the noise levels must satisfy 0 <= sigma_min < sigma_max <= 1, not "
                f"sigma_min {self.sigma_min}, sigma_max {self.sigma_max}."
            )

    @classmethod
    def of_wan(cls, shift: float) -> FlowSchedule:
        """Noise levels of Wan's own UniPC: from the shifted 0.999 down, whole timesteps."""
        return cls(shift=shift, sigma_max=0.999, timestep_rounding="down")

    def sigma(self, u: Numbers) -> Numbers:
        """Noise level at the uniform positions `u` in [0, 1]."""
        w = self.sigma_min + (self.sigma_max - self.sigma_min) * u
        return self.shift * w / (1 + (self.shift - 1) * w)

    def sigmas(self, steps: int) -> Float[np.ndarray, " stops"]:
        """The `steps` + 1 noise levels of a sampler in float64, falling to 0."""
        if steps < 1:
            raise InputError(f"{steps} steps cannot be sampled: it takes at least 1. (--steps)")
        return np.append(self.sigma(np.linspace(1.0, 0.0, steps + 1)[:-1]), 0.0)

    def timesteps(self, sigmas: Numbers) -> Numbers:
        """What the network is told at these noise levels: 1000 sigma, rounded as configured."""
        t = TIMESTEPS * sigmas
        if self.timestep_rounding == "none":
            return t
        if self.timestep_rounding == "down":
            return np.floor(t) if isinstance(t, np.ndarray) else jnp.floor(t)
        if isinstance(t, np.ndarray):
            return t.astype(ml_dtypes.bfloat16).astype(t.dtype)
        # Not a pair of casts, which the compiler may cancel out.
        return jax.lax.reduce_precision(t, exponent_bits=8, mantissa_bits=7)
