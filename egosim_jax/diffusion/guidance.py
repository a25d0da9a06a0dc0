"""Classifier-free guidance (Ho & Salimans 2022), on a network's predictions y.

    y = y_uncond + scale (y_cond - y_uncond)

Data, noise and velocity are linear in each other, so every prediction type is guided alike. At
scale 1 this is y_cond, and the unconditional branch is not run: the EgoSim release samples like
this, with one forward pass a step. Other scales need two passes, one after the other. A single
video fills the device, so a batch of both would only take more memory.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Array, Float

from egosim_jax.diffusion.process import DenoiseFn, at_least_float32


@dataclass(frozen=True, kw_only=True)
class Guidance:
    """Classifier-free guidance and its scale."""

    scale: float = 1.0
    """Guidance scale: 1 is the conditional prediction, above 1 extrapolates beyond it."""

    def guide(self, conditional: DenoiseFn, unconditional: DenoiseFn) -> DenoiseFn:
        """Return the guided prediction of two branches; `conditional` itself at scale 1."""
        if self.scale == 1:
            return conditional

        def guided(
            x: Float[Array, "b f h w c"], t: Float[Array, " b"]
        ) -> Float[Array, "b f h w c"]:
            without = at_least_float32(unconditional(x, t))
            return without + self.scale * (at_least_float32(conditional(x, t)) - without)

        return guided
