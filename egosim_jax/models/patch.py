"""Patch embedding of noisy latents and their condition.

The embedding is linear, so the contribution of the condition, which is the same at every denoising
step, is computed once.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.types import InputError


class PatchEmbedding(nnx.Module):
    """Linear embedding of each patch, with a kernel `[channel, row, column, out]`."""

    def __init__(self, config: Any, *, patch: int, rngs: nnx.Rngs):
        """Take the channels, the width and the dtype of a denoiser's config."""
        shape = (config.in_channels, patch, patch, config.dim)
        init = nnx.initializers.xavier_uniform(in_axis=(0, 1, 2))
        self.noisy_channels, self.patch = config.out_channels, patch
        self.dtype = jnp.dtype(config.dtype)
        self.kernel = nnx.Param(init(rngs.params(), shape), axes=(None, None, None, "embed"))
        self.bias = nnx.Param(jnp.zeros(config.dim), axes=("embed",))

    def noisy(self, latents: Float[Array, "b f h w c"]) -> Float[Array, "b n d"]:
        """Return the contribution of the noisy channels."""
        return self._project(latents, self.kernel[...][: self.noisy_channels])

    def condition(self, latents: Float[Array, "b f h w c"]) -> Float[Array, "b n d"]:
        """Return the contribution of the condition, with the bias."""
        share = self._project(latents, self.kernel[...][self.noisy_channels :])
        return share + self.bias[...].astype(self.dtype)

    def _project(
        self, latents: Float[Array, "b f h w c"], kernel: Float[Array, "c i j d"]
    ) -> Float[Array, "b n d"]:
        patches = rearrange(
            latents, "b f (h i) (w j) c -> b (f h w) (c i j)", i=self.patch, j=self.patch
        )
        kernel = rearrange(kernel, "c i j d -> (c i j) d")
        return patches.astype(self.dtype) @ kernel.astype(self.dtype)

    def check(self, condition: tuple[int, ...]) -> None:
        """Raise `InputError` unless a condition `b f h w c` fits the channels and the patches."""
        _, _, h, w, channels = condition
        in_channels, patch = self.kernel.shape[0], self.patch
        if channels != in_channels - self.noisy_channels:
            raise InputError(
                f"A condition of {channels} channels does not fit this model: it reads "
                f"{in_channels - self.noisy_channels} in addition to the {self.noisy_channels} "
                f"noisy ones (in_channels {in_channels})."
            )
        if h % patch or w % patch:
            raise InputError(
                f"Latents of {h} x {w} cells do not split into patches of {patch} x {patch}: both "
                "sizes must be even (pixels in multiples of 16)."
            )
