"""Steps that reuse the network's last prediction, where it would hardly change.

A forward pass at one of many steps predicts nearly what the pass before it did. With input x_n and
prediction y_n of step n, and the change of the prediction per change of the input at the last two
passes, k = |y_m - y_l| / |x_m - x_l|, the relative error of reusing a prediction is estimated as

    e_n = k |x_n - x_{n-1}| / |y_{n-1}|

While these errors, summed since the last pass, stay below a threshold, a step takes its prediction
from that pass, moved with the input: y_n = y_m + (x_n - x_m). Source: EasyCache (Zhou et al. 2025,
arXiv 2507.02860).

Each sample decides by itself, so that a batch gives what its samples give alone. The network runs
at a step if one sample of the batch needs it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from egosim_jax.diffusion.process import DenoiseFn
from egosim_jax.types import InputError


class Memory(NamedTuple):
    """Memory of the steps so far."""

    x: Float[Array, "b f h w c"]
    """Input of the step before."""
    output: Float[Array, "b f h w c"]
    """Prediction of the step before."""
    offset: Float[Array, "b f h w c"]
    """Prediction of the last forward pass less its input."""
    rate: Float[Array, " b"]
    """Change of the prediction per change of the input, at the last forward pass."""
    error: Float[Array, " b"]
    """Sum of the estimated errors since the last forward pass."""


@dataclass(frozen=True, kw_only=True)
class StepCache:
    """Reuse of predictions in sampling; off means exact."""

    threshold: float
    """Estimated relative error of a prediction from which the network runs again."""
    first: int = 4
    """Number of steps at the start that always run the network; the last step always does."""

    def __post_init__(self) -> None:
        if not 0 < self.threshold < 1:
            raise InputError(
                f"{self.threshold:g} is no threshold of reused steps: it must be above 0 and below "
                "1. Omit it, to run the network at every step. (--cache)"
            )
        if self.first < 2:
            raise InputError(f"At least 2 first steps must be computed, not {self.first}. (first)")

    def due(self, steps: int) -> Bool[np.ndarray, " s"]:
        """Return which steps run the network in any case."""
        numbers = np.arange(steps)
        return (numbers < self.first) | (numbers == steps - 1)

    def start(self, noise: Float[Array, "b f h w c"]) -> Memory:
        """Return the memory before the first step."""
        zeros, none = jnp.zeros(noise.shape), jnp.zeros(len(noise))
        return Memory(zeros, zeros, zeros, rate=none, error=none)

    def predict(
        self,
        denoise: DenoiseFn,
        memory: Memory,
        x: Float[Array, "b f h w c"],
        t: Float[Array, " b"],
        due: Bool[Array, ""],
    ) -> tuple[Float[Array, "b f h w c"], Memory]:
        """Return the prediction of a step, computed or reused, and the memory after it."""
        x = x.astype(jnp.float32)
        change = _size(x - memory.x)
        error = memory.error + memory.rate * change / jnp.maximum(_size(memory.output), 1e-12)
        runs = due | (error >= self.threshold)
        reused = x + memory.offset
        computed = jax.lax.cond(
            runs.any(), lambda: denoise(x, t).astype(jnp.float32), lambda: reused
        )
        output = jnp.where(_wide(runs), computed, reused)
        rate = _size(output - memory.output) / jnp.maximum(change, 1e-12)
        return output, Memory(
            x=x,
            output=output,
            offset=jnp.where(_wide(runs), output - x, memory.offset),
            rate=jnp.where(runs, rate, memory.rate),
            error=jnp.where(runs, 0.0, error),
        )


def _size(x: Float[Array, "b f h w c"]) -> Float[Array, " b"]:
    return jnp.abs(x).mean(axis=(1, 2, 3, 4))


def _wide(samples: Bool[Array, " b"]) -> Bool[Array, "b 1 1 1 1"]:
    return samples[:, None, None, None, None]
