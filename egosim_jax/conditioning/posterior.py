"""Random encoding of videos: latents drawn from the VAE's posterior, and noise on the prior.

A VAE gives mean and deviation of a video's latents. EgoSim takes the means, in training and at
generation. DWM draws target and conditions at each training update; at generation its release draws
the latents of the hands but not of the prior. The paper was evaluated with CogVideoX-Fun's own
pipeline, which also adds noise to the pixels of the prior that are not black.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from egosim_jax.types import InputError

STD = "_std"
"""End of the names of deviations in records of latents, after the name of their means."""
BLACK = -1.0
"""Value of a black pixel in [-1, 1], to which no noise is added."""


@runtime_checkable
class NormalizedCodec(Protocol):
    """Video codec whose normalization can be applied to drawn latents."""

    def moments(
        self, video: Float[Array, "b f h w 3"]
    ) -> tuple[Float[Array, "b f2 h2 w2 z"], Float[Array, "b f2 h2 w2 z"]]:
        """Return mean and log variance of the latents, before normalization."""
        ...

    def normalize(self, mean: Float[Array, "b f h w z"]) -> Float[Array, "b f h w z"]:
        """Normalize latents, by an affine function of each channel."""
        ...


@dataclass(frozen=True, kw_only=True)
class EncodingNoise:
    """Randomness in the encoding of conditions when a clip is generated."""

    hands: bool = False
    """Draw the latents of the hands from the posterior, instead of taking their means."""
    prior_pixels: float = 0.0
    """Deviation of the noise on the prior's pixels in [-1, 1]; black ones get none."""

    def __post_init__(self) -> None:
        if not self.prior_pixels >= 0:
            raise InputError(f"prior_pixels must be at least 0, not {self.prior_pixels}.")


def posterior(
    vae: NormalizedCodec, video: Float[Array, "b f h w 3"]
) -> tuple[Float[Array, "b f2 h2 w2 z"], Float[Array, "b f2 h2 w2 z"]]:
    """Return mean and standard deviation of the normalized latents of a video."""
    mean, logvar = vae.moments(video)
    center = vae.normalize(mean)
    return center, vae.normalize(mean + jnp.exp(logvar / 2)) - center


def draw(
    mean: Float[Array, "b f h w z"],
    std: Float[Array, "b f h w z"],
    keys: Key[Array, " b"],
) -> Float[Array, "b f h w z"]:
    """Draw the latents of each sample from its own key."""
    return mean + std * normal(keys, mean)


def add_pixel_noise(
    video: Float[Array, "b f h w 3"], std: float, keys: Key[Array, " b"]
) -> Float[Array, "b f h w 3"]:
    """Add noise to the values of a video that are not black."""
    return jnp.where(video == BLACK, video, video + std * normal(keys, video))


def normal(keys: Key[Array, " b"], like: Float[Array, "b f h w c"]) -> Float[Array, "b f h w c"]:
    """Draw standard normal numbers for each sample from its own key."""
    return jax.vmap(lambda key: jax.random.normal(key, like.shape[1:]))(keys)
