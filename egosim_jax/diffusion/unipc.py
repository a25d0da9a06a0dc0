"""UniPC, a multistep predictor-corrector solver.

UniPC (Zhao et al. 2023, "UniPC: A Unified Predictor-Corrector Framework"; its multistep form for
data prediction with B(h) = e^h - 1, "bh2" in the authors' code) solves the sampling equation in
half the log signal-to-noise ratio, lambda = log(alpha / sigma), where only the predicted data m_i
have to be extrapolated. A step from s to t of length h = lambda_t - lambda_s is

    x_t = (sigma_t / sigma_s) x_s + alpha_t (1 - e^-h) [ m_s + sum_k (rho_k / r_k) (m_k - m_s) ]

over other predictions m_k at r_k = (lambda_k - lambda_s) / h: earlier ones in the predictor
(r < 0), and also that at t itself in the corrector (r = 1), which repeats the last step once the
network has been evaluated at its end. A single rho is 1/2; several solve, for j = 1, 2, ...,

    sum_k rho_k r_k^(j-1) = b_j,    b_j = j! h phi_{j+1}(-h) / (1 - e^-h)
    phi_1(z) = (e^z - 1) / z,       phi_{j+1}(z) = (phi_j(z) - 1/j!) / z

A step of order p uses p - 1 earlier predictions besides m_s. The order grows from 1 with the
predictions at hand and falls back to 1 at the end, where h is infinite. So a step is linear: with
M_i = (m_i, m_{i-1}, ..., m_{i-p}) and x~ the corrected latents,

    x~_i    = a x_i + b x~_{i-1} + c . M_i     (a = 1 and the rest 0 in the first step, else a = 0)
    x_{i+1} = d x~_i + e . M_i
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from egosim_jax.diffusion.process import Process
from egosim_jax.types import InputError

CLOSEST_TO_NOISE = 1 - 1e-6
"""Noisiest time: lambda is minus infinity at time 1 (diffusers does the same)."""


class _Path(NamedTuple):
    """The process at the visited times."""

    alpha: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    half_log_snr: Float[np.ndarray, " n"]


class UniPCState(NamedTuple):
    """Latents, and what the corrector and the next predictions use of earlier steps."""

    x: Float[Array, "*x"]
    corrected: Float[Array, "*x"]
    """Corrected latents of the step before."""
    predictions: Float[Array, " order *x"]
    """Predicted data of the steps before, latest first."""


class UniPCRow(NamedTuple):
    """Coefficients of one UniPC step; with a leading step axis, of all steps."""

    alpha: Float[Any, ""]
    """Scale of the data at the step's start, to predict the data."""
    sigma: Float[Any, ""]
    """Scale of the noise there."""
    keep: Float[Any, ""]
    """Factor a: 1 in the first step, which has nothing to correct."""
    correct_from: Float[Any, ""]
    """Factor b of the corrected latents of the step before."""
    correct: Float[Any, " order+1"]
    """Factors c of the predictions, latest first."""
    predict_from: Float[Any, ""]
    """Factor d of the corrected latents."""
    predict: Float[Any, " order+1"]
    """Factors e of the predictions, latest first."""


@dataclass(frozen=True, kw_only=True)
class UniPC:
    """Multistep predictor-corrector: fewer steps for the same error, one evaluation each."""

    order: int = 2
    """Order of the predictor; the corrector's is one higher."""

    stochastic = False

    def __post_init__(self) -> None:
        if self.order < 1:
            raise InputError(f"UniPC's order must be at least 1, not {self.order}; take 2 or 3.")

    def coefficients(self, process: Process, times: Float[np.ndarray, " times"]) -> UniPCRow:
        """Return the linear form of every step."""
        times = np.minimum(times, CLOSEST_TO_NOISE)
        path = _Path(process.alpha(times), process.sigma(times), process.half_log_snr(times))
        if path.alpha[0] == 0:
            raise InputError(
                "UniPC needs signal at the first timestep, which zero_terminal_snr removes. Take "
                "another solver: DDIM or DPM++."
            )
        steps = len(times) - 1
        orders = [min(self.order, i + 1, steps - i) for i in range(steps)]
        rows = []
        for i in range(steps):
            b, c = 0.0, np.zeros(self.order + 1)
            if i > 0:
                known = [i - 1 - k for k in range(orders[i - 1])]
                b, weights = _step(path, [*known, i], i)
                c[0], c[1 : len(weights)] = weights[-1], weights[:-1]
            e = np.zeros(self.order + 1)
            d, e[: orders[i]] = _step(path, [i - k for k in range(orders[i])], i + 1)
            rows.append(UniPCRow(path.alpha[i], path.sigma[i], float(i == 0), b, c, d, e))
        return UniPCRow(*(np.asarray(column, np.float32) for column in zip(*rows, strict=True)))

    def start(self, x: Float[Array, "*x"]) -> UniPCState:
        """Return the noise as the first latents, without predictions."""
        x = x.astype(jnp.float32)
        return UniPCState(x, jnp.zeros_like(x), jnp.zeros((self.order, *x.shape)))

    def step(
        self,
        process: Process,
        state: UniPCState,
        output: Float[Array, "*x"],
        row: UniPCRow,
        keys: Key[Array, " b"] | None = None,
    ) -> UniPCState:
        """Predict the data, correct the step that led here, and predict the next latents."""
        data = process.to_x0(state.x, output.astype(jnp.float32), row.alpha, row.sigma)
        predictions = jnp.concatenate([data[None], state.predictions])
        corrected = (
            row.keep * state.x
            + row.correct_from * state.corrected
            + _combine(row.correct, predictions)
        )
        x = row.predict_from * corrected + _combine(row.predict, predictions)
        return UniPCState(x, corrected, predictions[:-1])


def _combine(weights: Float[Array, " k"], terms: Float[Array, " k *x"]) -> Float[Array, "*x"]:
    return jnp.einsum("k,k...->...", weights, terms, precision="highest")


def _step(path: _Path, known: list[int], target: int) -> tuple[float, Float[np.ndarray, " k"]]:
    """Return the coefficients of a step to `target` from `known[0]`, with predictions at `known`.

    First the weight of the latents at `known[0]`, then the weights of the predictions.
    """
    source, half_log_snr = known[0], path.half_log_snr
    h = half_log_snr[target] - half_log_snr[source]
    ratios = (half_log_snr[known[1:]] - half_log_snr[source]) / h
    slopes = _rhos(ratios, h) / ratios
    weights = np.concatenate([[1 - slopes.sum()], slopes])
    return path.sigma[target] / path.sigma[source], -path.alpha[target] * np.expm1(-h) * weights


def _rhos(ratios: Float[np.ndarray, " k"], h: float) -> Float[np.ndarray, " k"]:
    """Return the weights of the differences to predictions at these ratios of the step."""
    count = len(ratios)
    if count < 2:
        return np.full(count, 0.5)
    b, phi = [], np.expm1(-h) / -h
    for j in range(1, count + 1):
        phi = (phi - 1 / math.factorial(j)) / -h  # phi_{j+1}(-h)
        b.append(math.factorial(j) * h * phi / -np.expm1(-h))
    return np.linalg.solve(ratios ** np.arange(count)[:, None], np.array(b))
