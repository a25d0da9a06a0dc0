"""Classifier-free guidance (Ho & Salimans 2022), in velocities.

    v = v_uncond + scale (v_cond - v_uncond)

At scale 1 this is v_cond, and the unconditional branch is not run: the EgoSim release samples so,
one forward pass a step. Other scales cost two, one after the other: at the sizes of video a single
sample fills the device, so that a batch of both would only take more memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from egosim_jax.diffusion.schedule import VelocityFn


@dataclass(frozen=True, kw_only=True)
class Guidance:
    """How far to go beyond the condition."""

    scale: float = 1.0
    """1 follows the condition; above 1 exaggerates what sets it apart from none."""

    def guide(self, conditional: VelocityFn, unconditional: VelocityFn) -> VelocityFn:
        """The guided velocity of two branches; `conditional` itself at scale 1."""
        if self.scale == 1:
            return conditional

        def velocity(
            x: Float[Array, "b f h w c"], t: Float[Array, " b"]
        ) -> Float[Array, "b f h w c"]:
            without = unconditional(x, t).astype(jnp.float32)
            return without + self.scale * (conditional(x, t).astype(jnp.float32) - without)

        return velocity
