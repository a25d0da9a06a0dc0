"""The denoiser's 52 input channels: the only place that knows their order.

    0-15    noisy latents
    16-19   mask, 1 = generate (`mask.py`)
    20-35   prior latents x (1 - mask channel 0)
    36-51   hands latents, not masked

The prior is masked in latent space and by the first of the four mask channels alone: an unobserved
cell is latent 0, not the latent of gray or black (EgoSim release).
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from egosim_jax.types import Condition

NOISY = slice(0, 16)
"""Channels of the latents being denoised."""
MASK = slice(16, 20)
"""Channels of the mask."""
PRIOR = slice(20, 36)
"""Channels of the masked prior."""
HANDS = slice(36, 52)
"""Channels of the hands."""
CHANNELS = HANDS.stop
"""Input channels of an EgoSim denoiser."""


def condition_channels(condition: Condition) -> Float[Array, "b f h w 36"]:
    """Channels 16 to 51, the same at every step, in the dtype of the prior."""
    prior = jnp.asarray(condition.prior)
    mask = jnp.asarray(condition.mask, prior.dtype)
    hands = jnp.asarray(condition.hands, prior.dtype)
    return jnp.concatenate([mask, prior * (1 - mask[..., :1]), hands], axis=-1)


def assemble(noisy: Float[Array, "b f h w 16"], condition: Condition) -> Float[Array, "b f h w 52"]:
    """The denoiser's input: noisy latents, then the condition's channels."""
    return jnp.concatenate([noisy, condition_channels(condition)], axis=-1)
