"""Solvers of the sampling equation dx/dsigma = v(x, 1000 sigma), from noise down to sigma = 0.

Every coefficient depends on the noise levels alone, so `plan` computes them for all steps on the
host in float64, and the whole integration is one `lax.scan` over their rows (`integrate`).
Latents stay float32 between steps whatever the network computes in.

Euler walks the straight line of the present velocity:

    x_{i+1} = x_i + (sigma_{i+1} - sigma_i) v_i

UniPC (Zhao et al. 2023, "UniPC: A Unified Predictor-Corrector Framework"; its multistep form for
data prediction with B(h) = e^h - 1, "bh2" in the authors' code) solves the same equation in half
the log signal-to-noise ratio, lambda = log((1 - sigma) / sigma), where only the predicted data
m_i = x_i - sigma_i v_i have to be extrapolated. With alpha = 1 - sigma, a step from s to t of
length h = lambda_t - lambda_s is

    x_t = (sigma_t / sigma_s) x_s + alpha_t (1 - e^-h) [ m_s + sum_k (rho_k / r_k) (m_k - m_s) ]

over other predictions m_k at r_k = (lambda_k - lambda_s) / h: earlier ones in the predictor
(r < 0), and also that at t itself in the corrector (r = 1), which redoes the last step once the
network has seen where it led. A single rho is 1/2; several solve, for j = 1, 2, ...,

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
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from egosim_jax.diffusion.schedule import FlowSchedule, VelocityFn
from egosim_jax.types import InputError

CLOSEST_TO_NOISE = 1 - 1e-6
"""UniPC's noisiest level: lambda is minus infinity at sigma = 1 (diffusers does the same)."""


@runtime_checkable
class Solver(Protocol):
    """A rule that walks from noise to data; its state, a pytree, has the latents as `x`."""

    def plan(self, sigmas: Float[np.ndarray, " stops"]) -> Any:
        """Coefficients of every step: a pytree of float32 arrays with a leading step axis."""
        ...

    def start(self, x: Float[Array, "*x"]) -> Any:
        """The state before the first step, at the first noise level."""
        ...

    def step(self, state: Any, velocity: Float[Array, "*x"], row: Any) -> Any:
        """Take one step with its row of the plan and the velocity at `state.x`."""
        ...


def integrate(
    velocity_fn: VelocityFn,
    noise: Float[Array, "b f h w c"],
    *,
    schedule: FlowSchedule,
    solver: Solver,
    steps: int,
) -> Float[Array, "b f h w c"]:
    """Turn noise into latents by `steps` evaluations of the velocity: one scan, no host trips."""
    sigmas = schedule.sigmas(steps)
    timesteps = schedule.timesteps(sigmas[:-1]).astype(np.float32)

    def body(state: Any, row: tuple) -> tuple[Any, None]:
        t, coefficients = row
        velocity = velocity_fn(state.x, jnp.broadcast_to(t, noise.shape[:1]))
        return solver.step(state, velocity, coefficients), None

    state, _ = jax.lax.scan(body, solver.start(noise), (timesteps, solver.plan(sigmas)))
    return state.x


class EulerState(NamedTuple):
    """The latents alone."""

    x: Float[Array, "*x"]


@dataclass(frozen=True, kw_only=True)
class Euler:
    """First-order steps along the velocity: the sampler of the EgoSim release."""

    def plan(self, sigmas: Float[np.ndarray, " stops"]) -> Float[np.ndarray, " steps"]:
        """The change of noise level of each step."""
        return np.diff(sigmas).astype(np.float32)

    def start(self, x: Float[Array, "*x"]) -> EulerState:
        """The noise."""
        return EulerState(x.astype(jnp.float32))

    def step(
        self, state: EulerState, velocity: Float[Array, "*x"], row: Float[Array, ""]
    ) -> EulerState:
        """Walk along the velocity."""
        return EulerState(state.x + row * velocity.astype(jnp.float32))


class UniPCState(NamedTuple):
    """Latents, and what the corrector and the next predictions need of earlier steps."""

    x: Float[Array, "*x"]
    corrected: Float[Array, "*x"]
    """The corrected latents of the step before."""
    predictions: Float[Array, " order *x"]
    """Predicted data of the steps before, latest first."""


class UniPCRow(NamedTuple):
    """One step's coefficients; in a plan, each has a leading step axis."""

    sigma: Float[Any, ""]
    """The step's noise level, to predict the data."""
    keep: Float[Any, ""]
    """a: 1 in the first step, which has nothing to correct."""
    correct_from: Float[Any, ""]
    """b: of the corrected latents of the step before."""
    correct: Float[Any, " order+1"]
    """c: of the predictions, latest first."""
    predict_from: Float[Any, ""]
    """d: of the corrected latents."""
    predict: Float[Any, " order+1"]
    """e: of the predictions, latest first."""


@dataclass(frozen=True, kw_only=True)
class UniPC:
    """Multistep predictor-corrector: fewer steps for the same error, one evaluation each."""

    order: int = 2
    """Order of the predictor; the corrector's is one higher."""

    def __post_init__(self) -> None:
        """Check the order."""
        if self.order < 1:
            raise InputError(f"UniPC's order must be at least 1, not {self.order}; take 2 or 3.")

    def plan(self, sigmas: Float[np.ndarray, " stops"]) -> UniPCRow:
        """The linear form of every step."""
        sigmas = np.minimum(sigmas, CLOSEST_TO_NOISE)
        steps = len(sigmas) - 1
        orders = [min(self.order, i + 1, steps - i) for i in range(steps)]
        rows = []
        for i in range(steps):
            b, c = 0.0, np.zeros(self.order + 1)
            if i > 0:
                known = [i - 1 - k for k in range(orders[i - 1])]
                b, weights = _step(sigmas, [*known, i], i)
                c[0], c[1 : len(weights)] = weights[-1], weights[:-1]
            e = np.zeros(self.order + 1)
            d, e[: orders[i]] = _step(sigmas, [i - k for k in range(orders[i])], i + 1)
            rows.append(UniPCRow(sigmas[i], float(i == 0), b, c, d, e))
        return UniPCRow(*(np.asarray(column, np.float32) for column in zip(*rows, strict=True)))

    def start(self, x: Float[Array, "*x"]) -> UniPCState:
        """The noise, and no predictions yet."""
        x = x.astype(jnp.float32)
        return UniPCState(x, jnp.zeros_like(x), jnp.zeros((self.order, *x.shape)))

    def step(self, state: UniPCState, velocity: Float[Array, "*x"], row: UniPCRow) -> UniPCState:
        """Predict the data, correct the step that led here, and predict the next latents."""
        data = state.x - row.sigma * velocity.astype(jnp.float32)
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


def _step(
    sigmas: Float[np.ndarray, " stops"], known: list[int], target: int
) -> tuple[float, Float[np.ndarray, " k"]]:
    """Coefficients of a step to `target` from `known[0]`, with predictions at all of `known`.

    Returns that of the latents at `known[0]`, then those of the predictions.
    """
    source = known[0]
    with np.errstate(divide="ignore"):  # lambda is infinite at sigma = 0
        half_log_snr = np.log1p(-sigmas) - np.log(sigmas)
    h = half_log_snr[target] - half_log_snr[source]
    ratios = (half_log_snr[known[1:]] - half_log_snr[source]) / h
    slopes = _rhos(ratios, h) / ratios
    weights = np.concatenate([[1 - slopes.sum()], slopes])
    return sigmas[target] / sigmas[source], -(1 - sigmas[target]) * np.expm1(-h) * weights


def _rhos(ratios: Float[np.ndarray, " k"], h: float) -> Float[np.ndarray, " k"]:
    """Weights of the differences to predictions at these ratios of the step."""
    count = len(ratios)
    if count < 2:
        return np.full(count, 0.5)
    b, phi = [], np.expm1(-h) / -h
    for j in range(1, count + 1):
        phi = (phi - 1 / math.factorial(j)) / -h  # phi_{j+1}(-h)
        b.append(math.factorial(j) * h * phi / -np.expm1(-h))
    return np.linalg.solve(ratios ** np.arange(count)[:, None], np.array(b))
