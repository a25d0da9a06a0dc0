"""Classifier-free guidance (Ho & Salimans 2022), on a network's predictions y.

    y = y_uncond + scale (y_cond - y_uncond)

Data, noise and velocity are linear in each other, so every prediction type is guided alike. At
scale 1 this is y_cond, and the unconditional branch is not run: the EgoSim release samples like
this, with one forward pass a step. Other scales need two passes, one after the other. A single
video fills the device, so a batch of both would only take more memory.

Guidance matters most at medium noise: it may be limited to an interval of timesteps. Outside of it
the second pass is not run (Kynkäänniemi et al. 2024).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from egosim_jax.diffusion.process import DenoiseFn, at_least_float32
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class Guidance:
    """Classifier-free guidance and its scale."""

    scale: float = 1.0
    """Guidance scale: 1 is the conditional prediction, above 1 extrapolates beyond it."""
    interval: tuple[float | int, float | int] | None = None
    """Lowest and highest timestep that is guided, of 0 (data) to 1000 (noise); None: all."""

    def __post_init__(self) -> None:
        if self.interval is None:
            return
        low, high = self.interval
        if not 0 <= low < high <= 1000:
            raise InputError(
                f"{low:g} to {high:g} is no interval of timesteps: the first must be at least 0 "
                "and below the second, and the second at most 1000. (--guidance-interval)"
            )
        if self.scale == 1:
            raise InputError(
                "A guidance interval has no effect at scale 1, where no step is guided: omit "
                "it, or give another scale. (--guidance-interval, --guidance)"
            )

    def guide(self, conditional: DenoiseFn, unconditional: DenoiseFn) -> DenoiseFn:
        """Return the guided prediction of two branches; `conditional` itself at scale 1."""
        if self.scale == 1:
            return conditional

        def guided(
            x: Float[Array, "b f h w c"], t: Float[Array, " b"]
        ) -> Float[Array, "b f h w c"]:
            with_text = at_least_float32(conditional(x, t))
            if self.interval is None:
                without = at_least_float32(unconditional(x, t))
            else:
                inside = (t >= self.interval[0]) & (t <= self.interval[1])
                without = jax.lax.cond(
                    inside.any(),
                    lambda: at_least_float32(unconditional(x, t)),
                    lambda: with_text,
                )
                without = jnp.where(inside[:, None, None, None, None], without, with_text)
            return without + self.scale * (with_text - without)

        return guided
