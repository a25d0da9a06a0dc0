"""DPM-Solver++ (2M), a multistep solver of the sampling equation or of its stochastic form.

DPM-Solver++ (Lu et al. 2022, "DPM-Solver++: Fast Solver for Guided Sampling of Diffusion
Probabilistic Models") extrapolates the predicted data m in half the log signal-to-noise ratio,
lambda = log(alpha / sigma). A step from s to t of length h, after one of length h', is

    D   = m_s + (h / 2 h') (m_s - m_before)
    x_t = (sigma_t / sigma_s) x_s + alpha_t (1 - e^-h) D

and in its stochastic form ("SDE", the CogVideoX sampler `CogVideoXDPMScheduler`)

    x_t = (sigma_t / sigma_s) e^-h x_s + alpha_t (1 - e^-2h) D + sigma_t sqrt(1 - e^-2h) n

with n ~ N(0, 1). The first step, and the last, where h is infinite, take D = m_s. So does the step
after one from pure noise, where h' is infinite.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from egosim_jax.diffusion.process import Process, at_least_float32
from egosim_jax.diffusion.solver import sample_noise


class DPMSolverState(NamedTuple):
    """Latents, and the predicted data of the step before."""

    x: Float[Array, "*x"]
    before: Float[Array, "*x"]


class DPMSolverRow(NamedTuple):
    """Coefficients of one DPM-Solver++ step; with a leading step axis, of all steps."""

    alpha: Float[Any, ""]
    """Scale of the data at the step's start."""
    sigma: Float[Any, ""]
    """Scale of the noise there."""
    keep: Float[Any, ""]
    """Factor of the latents."""
    data: Float[Any, ""]
    """Factor of the predicted data."""
    before: Float[Any, ""]
    """Factor of the predicted data of the step before."""
    noise: Float[Any, ""]
    """Factor of the new noise."""


@dataclass(frozen=True, kw_only=True)
class DPMSolver:
    """DPM-Solver++ (2M): second order, one evaluation a step, on any process."""

    stochastic: bool = False
    """Add noise at each step (2M SDE)."""

    def coefficients(self, process: Process, times: Float[np.ndarray, " times"]) -> DPMSolverRow:
        """Return the linear form of every step."""
        alpha, sigma = process.alpha(times), process.sigma(times)
        h = np.diff(process.half_log_snr(times))
        # Infinite at pure noise and at the data: exp gives the limits.
        damping = np.exp(-h) if self.stochastic else np.ones_like(h)
        data = alpha[1:] * -np.expm1(-2 * h if self.stochastic else -h)
        slope = np.zeros_like(h)
        slope[1:-1] = h[1:-1] / (2 * h[:-2])
        columns = (
            alpha[:-1],
            sigma[:-1],
            sigma[1:] / sigma[:-1] * damping,
            data * (1 + slope),
            -data * slope,
            sigma[1:] * np.sqrt(1 - damping**2),
        )
        return DPMSolverRow(*columns)

    def start(self, x: Float[Array, "*x"]) -> DPMSolverState:
        """Return the noise as the first latents, without predictions."""
        x = at_least_float32(x)
        return DPMSolverState(x, jnp.zeros_like(x))

    def step(
        self,
        process: Process,
        state: DPMSolverState,
        output: Float[Array, "*x"],
        row: DPMSolverRow,
        keys: Key[Array, " b"] | None = None,
    ) -> DPMSolverState:
        """Predict the data and extrapolate them over the step; add new noise."""
        data = process.to_x0(state.x, at_least_float32(output), row.alpha, row.sigma)
        x = row.keep * state.x + row.data * data + row.before * state.before
        return DPMSolverState(x if keys is None else x + row.noise * sample_noise(keys, x), data)


SDE = DPMSolver(stochastic=True)
"""DPM-Solver++ (2M SDE)."""
