"""Diffusion processes: the path from data to noise, and what a network predicts on it.

A process joins a latent x0 to Gaussian noise e. At time t in [0, 1], from data to noise,

    x_t = alpha(t) x0 + sigma(t) e

A network sees x_t and a timestep, and predicts one of four quantities (`Prediction`):

    x0        the data
    epsilon   the noise e
    velocity  e - x0                       dx/dsigma on the straight path, alpha + sigma = 1
    v         alpha e - sigma x0           where alpha^2 + sigma^2 = 1 (Salimans & Ho 2022)

Any of them, with x_t, gives the data and the noise (`to_x0`, `to_epsilon`):

    velocity  x0 = x - sigma y             e = x + alpha y
    v         x0 = alpha x - sigma y       e = sigma x + alpha y

Two processes:

RectifiedFlow (flow matching, Lipman et al. 2023; Liu et al. 2023) is the straight path,

    alpha = 1 - t,   sigma = t,   timestep = 1000 t

Large latents need more of their time at high noise, so a uniform position u is warped by the shift
s (Esser et al. 2024; s = 5 in the EgoSim release):

    t(u) = s w / (1 + (s - 1) w),   w = sigma_min + (sigma_max - sigma_min) u

A sampler of N steps visits u = 1, 1 - 1/N, ..., 1/N and ends at t = 0.

VariancePreserving (DDPM, Ho et al. 2020) has T discrete timesteps n = 0 ... T - 1, at
times t = (n + 1) / T,

    a_n = prod_{i <= n} (1 - beta_i),   alpha = sqrt(a_n),   sigma = sqrt(1 - a_n)

and alpha = 1 at t = 0. CogVideoX first divides the signal-to-noise ratio by c = `snr_shift`,

    a <- a / (c + (1 - c) a)

and then moves sqrt(a) so that the last timestep has no signal (Lin et al. 2024):

    sqrt(a_n) <- (sqrt(a_n) - sqrt(a_{T-1})) sqrt(a_0) / (sqrt(a_0) - sqrt(a_{T-1}))
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, SupportsIndex, TypeVar

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
from jaxtyping import Array, Float

from egosim_jax.types import InputError

TIMESTEPS = 1000
"""Timestep of a rectified flow at time 1."""

DenoiseFn = Callable[
    [Float[Array, "b f h w c"], Float[Array, " b"]],
    Float[Array, "b f h w c"],
]
"""`denoise(x, timesteps)`: a network's prediction from noisy latents and their timesteps."""

Prediction = Literal["velocity", "v", "epsilon", "x0"]
"""Quantity that a network predicts."""

Numbers = TypeVar("Numbers", np.ndarray, jax.Array)


def at_least_float32(x: Float[Array, "*x"]) -> Float[Array, "*x"]:
    """Return an array in float32; float64 stays float64."""
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


class Process(ABC):
    """A path from data to noise, its sampling times and its prediction type."""

    prediction: Prediction

    @abstractmethod
    def alpha(self, time: Numbers) -> Numbers:
        """Return the scale of the data at these times."""

    @abstractmethod
    def sigma(self, time: Numbers) -> Numbers:
        """Return the scale of the noise at these times."""

    @abstractmethod
    def half_log_snr(self, time: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return log(alpha / sigma), half the log signal-to-noise ratio; may be infinite."""

    @abstractmethod
    def timesteps(self, time: Numbers) -> Numbers:
        """Return the network's timesteps at these times."""

    def exact_timesteps(self, time: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the timesteps at these times before any rounding; `times` takes them back."""
        return self.timesteps(time)

    @abstractmethod
    def warp(self, u: Numbers) -> Numbers:
        """Return the times at uniform positions `u` in [0, 1], to draw training times."""

    @abstractmethod
    def times(self, steps: SupportsIndex | Sequence[int | float]) -> Float[np.ndarray, " times"]:
        """Return the times that a sampler visits, in float64, falling to 0.

        `steps` is the number of steps, or the network's timesteps to visit.
        """

    def add_noise(self, x0: Numbers, noise: Numbers, time: Numbers) -> Numbers:
        """Return the noisy latents at these times."""
        return self.alpha(time) * x0 + self.sigma(time) * noise

    def target(self, x0: Numbers, noise: Numbers, time: Numbers) -> Numbers:
        """Return the quantity that the network is trained to predict."""
        match self.prediction:
            case "velocity":
                return noise - x0
            case "v":
                return self.alpha(time) * noise - self.sigma(time) * x0
            case "epsilon":
                return noise
            case "x0":
                return x0

    def to_x0(self, x: Numbers, output: Numbers, alpha: Numbers, sigma: Numbers) -> Numbers:
        """Return the data that a network's output predicts at noisy latents `x`."""
        match self.prediction:
            case "velocity":
                return x - sigma * output
            case "v":
                return alpha * x - sigma * output
            case "epsilon":
                return (x - sigma * output) / alpha
            case "x0":
                return output

    def to_epsilon(self, x: Numbers, output: Numbers, alpha: Numbers, sigma: Numbers) -> Numbers:
        """Return the noise that a network's output predicts at noisy latents `x`."""
        match self.prediction:
            case "velocity":
                return x + alpha * output
            case "v":
                return sigma * x + alpha * output
            case "epsilon":
                return output
            case "x0":
                return (x - alpha * output) / sigma

    def to_velocity(self, x: Numbers, output: Numbers, alpha: Numbers, sigma: Numbers) -> Numbers:
        """Return the velocity e - x0 that a network's output predicts at noisy latents `x`."""
        if self.prediction == "velocity":
            return output
        return self.to_epsilon(x, output, alpha, sigma) - self.to_x0(x, output, alpha, sigma)


@dataclass(frozen=True, kw_only=True)
class RectifiedFlow(Process):
    """The straight path from data to noise, with shifted noise levels."""

    shift: float = 5.0
    """Shift of the noise levels towards noise; 1 leaves them evenly spaced."""
    sigma_min: float = 0.0
    """Lower end of the range that is warped and divided into steps."""
    sigma_max: float = 1.0
    """Upper end of that range: the first noise level, before the shift."""
    timestep_rounding: Literal["none", "bfloat16", "down"] = "none"
    """Rounding of timesteps before they are embedded.

    `bfloat16` (spacing 4 above 512) is the EgoSim release's; `down`, to integers, is the rounding
    of Wan's own UniPC."""
    prediction: Prediction = "velocity"
    """Quantity that the network predicts: `velocity`, `epsilon` or `x0`."""

    def __post_init__(self) -> None:
        if not self.shift > 0:
            raise InputError(f"shift must be above 0, not {self.shift}; 1 means no shift.")
        if not 0 <= self.sigma_min < self.sigma_max <= 1:
            raise InputError(
                "the noise levels must satisfy 0 <= sigma_min < sigma_max <= 1, not "
                f"sigma_min {self.sigma_min}, sigma_max {self.sigma_max}."
            )
        if self.prediction == "epsilon" and self.sigma_max == 1:
            raise InputError(
                "prediction epsilon needs signal at every noise level: sigma_max must be below 1, "
                "such as 0.999."
            )
        _check_prediction(self, ("velocity", "epsilon", "x0"))

    @classmethod
    def wan_unipc(cls, shift: float) -> RectifiedFlow:
        """Return the process of Wan's own UniPC: from the shifted 0.999 down, whole timesteps."""
        return cls(shift=shift, sigma_max=0.999, timestep_rounding="down")

    def alpha(self, time: Numbers) -> Numbers:
        """Return the scale of the data, 1 - time."""
        return 1 - time

    def sigma(self, time: Numbers) -> Numbers:
        """Return the scale of the noise, the time itself."""
        return time

    def half_log_snr(self, time: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return log((1 - time) / time)."""
        with np.errstate(divide="ignore"):
            return np.log1p(-time) - np.log(time)

    def exact_timesteps(self, time: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return 1000 time."""
        return TIMESTEPS * time

    def timesteps(self, time: Numbers) -> Numbers:
        """Return 1000 time, rounded as configured."""
        t = TIMESTEPS * time
        if self.timestep_rounding == "none":
            return t
        if self.timestep_rounding == "down":
            return np.floor(t) if isinstance(t, np.ndarray) else jnp.floor(t)
        if isinstance(t, np.ndarray):
            return t.astype(ml_dtypes.bfloat16).astype(t.dtype)
        # Not a pair of casts: the compiler may cancel them.
        return jax.lax.reduce_precision(t, exponent_bits=8, mantissa_bits=7)

    def warp(self, u: Numbers) -> Numbers:
        """Return the shifted times at uniform positions `u` in [0, 1]."""
        w = self.sigma_min + (self.sigma_max - self.sigma_min) * u
        return self.shift * w / (1 + (self.shift - 1) * w)

    def times(self, steps: SupportsIndex | Sequence[int | float]) -> Float[np.ndarray, " times"]:
        """Return the shifted times of a sampler; given timesteps are not shifted."""
        if isinstance(given := _count(steps), int):
            visited = self.warp(np.linspace(1.0, 0.0, given + 1)[:-1])
        else:
            visited = _falling(given, low=0, high=TIMESTEPS) / TIMESTEPS
            if self.prediction == "epsilon" and visited[0] == 1:
                raise InputError(
                    f"timesteps {list(given)} cannot be sampled: prediction epsilon needs signal "
                    f"at every timestep, and {TIMESTEPS} has none. Start lower. (--steps)"
                )
        return np.append(visited, 0.0)


@dataclass(frozen=True, kw_only=True)
class VariancePreserving(Process):
    """The discrete process of DDPM; the defaults are CogVideoX 5B's."""

    train_timesteps: int = 1000
    """Number of timesteps, T."""
    beta_schedule: Literal["linear", "scaled_linear"] = "scaled_linear"
    """Spacing of the betas: even, or even in their square roots."""
    beta_start: float = 0.00085
    """Beta of the first timestep."""
    beta_end: float = 0.012
    """Beta of the last timestep."""
    snr_shift: float = 1.0
    """Divisor of the signal-to-noise ratio: 1 for CogVideoX 5B, 3 for 2B."""
    zero_terminal_snr: bool = True
    """Rescale so that the last timestep is pure noise."""
    spacing: Literal["trailing", "leading"] = "trailing"
    """Timesteps of a sampler: evenly spaced down from the last one, or up from the first one."""
    prediction: Prediction = "v"
    """Quantity that the network predicts: `v`, `epsilon` or `x0`."""

    def __post_init__(self) -> None:
        if not 0 < self.beta_start <= self.beta_end < 1:
            raise InputError(
                "the betas must satisfy 0 < beta_start <= beta_end < 1, not "
                f"beta_start {self.beta_start}, beta_end {self.beta_end}."
            )
        for name in ("train_timesteps", "snr_shift"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} must be above 0, not {getattr(self, name)}.")
        if self.prediction == "epsilon" and self.zero_terminal_snr:
            raise InputError(
                "prediction epsilon needs signal at every timestep: zero_terminal_snr must be "
                "False, or take prediction v."
            )
        _check_prediction(self, ("v", "epsilon", "x0"))

    def alpha(self, time: Numbers) -> Numbers:
        """Return the scale of the data, sqrt(a_n)."""
        return self._lookup(_scales(self)[0], time)

    def sigma(self, time: Numbers) -> Numbers:
        """Return the scale of the noise, sqrt(1 - a_n)."""
        return self._lookup(_scales(self)[1], time)

    def half_log_snr(self, time: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return log(alpha / sigma)."""
        with np.errstate(divide="ignore"):
            return np.log(self.alpha(time)) - np.log(self.sigma(time))

    def timesteps(self, time: Numbers) -> Numbers:
        """Return the timestep n = T time - 1."""
        t = self.train_timesteps * time - 1
        return np.rint(t) if isinstance(t, np.ndarray) else jnp.rint(t)

    def warp(self, u: Numbers) -> Numbers:
        """Return the times of the timesteps at uniform positions `u`, each as likely."""
        n = self.train_timesteps
        if isinstance(u, np.ndarray):
            return (np.minimum(np.floor(n * u), n - 1) + 1) / n
        return (jnp.minimum(jnp.floor(n * u), n - 1) + 1) / n

    def times(self, steps: SupportsIndex | Sequence[int | float]) -> Float[np.ndarray, " times"]:
        """Return the times of a sampler; given timesteps are integers."""
        n = self.train_timesteps
        if not isinstance(given := _count(steps), int):
            visited = _falling(given, low=-1, high=n - 1)
            if (visited != np.rint(visited)).any():
                raise InputError(f"timesteps {list(given)} must be integers. (--steps)")
        elif given > n:
            raise InputError(f"{given} steps are more than the {n} timesteps. (--steps)")
        elif self.spacing == "trailing":
            visited = np.rint(np.arange(given, 0, -1) * (n / given)) - 1
        else:
            visited = np.arange(given)[::-1] * float(n // given)
        return np.append((visited + 1) / n, 0.0)

    def _lookup(self, table: Float[np.ndarray, " levels"], time: Numbers) -> Numbers:
        level = self.train_timesteps * time
        if isinstance(level, np.ndarray):
            return table[np.rint(level).astype(int)]
        return jnp.asarray(table, jnp.float32)[jnp.rint(level).astype(jnp.int32)]


@cache
def _scales(process: VariancePreserving) -> tuple[np.ndarray, np.ndarray]:
    """Return alpha and sigma at times 0, 1/T, ..., 1 in float64."""
    low, high, n = process.beta_start, process.beta_end, process.train_timesteps
    if process.beta_schedule == "linear":
        betas = np.linspace(low, high, n)
    else:
        betas = np.linspace(low**0.5, high**0.5, n) ** 2
    a = np.cumprod(1 - betas)
    a = a / (process.snr_shift + (1 - process.snr_shift) * a)
    if process.zero_terminal_snr:
        root = np.sqrt(a)
        a = np.square((root - root[-1]) * root[0] / (root[0] - root[-1]))
    a = np.concatenate([[1.0], a])
    return np.sqrt(a), np.sqrt(1 - a)


def _check_prediction(process: Process, known: tuple[Prediction, ...]) -> None:
    if process.prediction not in known:
        raise InputError(
            f"prediction {process.prediction} is not defined for {type(process).__name__}: it must "
            f"be one of {', '.join(known)}."
        )


def _count(steps: SupportsIndex | Sequence[int | float]) -> int | Sequence[int | float]:
    """Return a number of steps of any integer type as an int, and timesteps as they are."""
    given: Any = steps
    if np.ndim(given):
        return given
    count = operator.index(given)
    if count < 1:
        raise InputError(f"{steps} steps cannot be sampled: at least 1 is needed. (--steps)")
    return count


def _falling(timesteps: Sequence[int | float], *, low: int, high: int) -> Float[np.ndarray, " n"]:
    """Return given timesteps as an array, checked."""
    visited = np.array(timesteps, np.float64)
    if not len(visited) or (np.diff(visited) >= 0).any():
        raise InputError(f"timesteps {list(timesteps)} must fall from step to step. (--steps)")
    if not (visited[0] <= high and visited[-1] > low):
        raise InputError(
            f"timesteps {list(timesteps)} must be above {low} and at most {high}. (--steps)"
        )
    return visited
