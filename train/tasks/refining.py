"""Refinement of a trained video VAE, with a perceptual term and more weight on motion.

The loss of `autoencoding` gets a term of LPIPS (`evaluation/metrics/lpips.py`, AlexNet) between
some frames of the crop and their reconstructions:

    perceptual_weight * mean over frames of LPIPS(y_t, x_t)

A latent cell allows many images. The squared error is smallest for their mean, which is a blur;
LPIPS is smaller for any single one. Training the decoder alone keeps the latents, so denoisers
that were trained on them stay valid.

Hands and carried objects cover little of a frame and are the hardest to reconstruct: they move
during the four frames of a latent cell. The squared error can weight each location by its motion,
the variance v of its color over the frames of the crop:

    1 + motion_weight * min(v / MOVING, 1),   divided by its mean over the crop
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Key

from egosim_jax.conditioning.pixels import to_model
from egosim_jax.configs.model import Networks
from egosim_jax.evaluation.metrics.lpips import Lpips
from egosim_jax.train.task import Batch, Metrics
from egosim_jax.train.tasks.autoencoding import Autoencoding
from egosim_jax.types import InputError

Part = Literal["all", "decoder"]
"""Trained part of a VAE."""
DECODER = ("decoder", "from_latents")
"""Modules that decode latents."""
MOVING = 0.02
"""Variance over time of colors in [-1, 1] from which a location counts as fully moving."""
MIN_CROP = 32
"""Minimum rows and columns of a crop for AlexNet, whose last layers would be empty."""


@dataclass(frozen=True, kw_only=True)
class Refining(Autoencoding):
    """The task of refining a trained VAE."""

    perceptual_weight: float = 0.1
    """Weight of the perceptual term; above 0 it needs egosim-jax[metrics]."""
    perceptual_frames: int = 4
    """Number of random frames of a crop that the perceptual term compares."""
    motion_weight: float = 0.0
    """Additional weight of the squared error at motion."""
    part: Part = "all"
    """Trained part; decoder: the latents do not change."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.perceptual_weight and min(self.crop) < MIN_CROP:
            raise InputError(
                f"A crop of {self.crop[0]} x {self.crop[1]} pixels is too small for LPIPS: it must "
                f"have at least {MIN_CROP} rows and columns, or --perceptual-weight be 0. (--crop)"
            )
        if not 0 < self.perceptual_frames <= self.video.frames:
            raise InputError(
                f"The perceptual term must compare 1 to {self.video.frames} frames, all of a crop, "
                f"not {self.perceptual_frames}. (--perceptual-frames)"
            )

    def networks(self, rngs: nnx.Rngs) -> Networks:
        """Return the VAE with random weights, as the only network of a model."""
        return Networks(vae=super().networks(rngs))

    @property
    def trained(self) -> Any:
        """The nnx filter of the trained weights: all, or the decoder."""
        if self.part == "all":
            return nnx.Param
        return lambda path, value: isinstance(value, nnx.Param) and path[1] in DECODER

    def loss(
        self, networks: Networks, batch: Batch, keys: Key[Array, " b"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the loss of the module docstring, for sampled latents."""
        video = to_model(batch["video"])
        decoded, loss, metrics = self.reconstruct(networks.vae, video, keys[0])
        return self._with_lpips(loss, metrics, decoded, video, jax.random.fold_in(keys[0], 1))

    def squared_error(
        self, decoded: Float[Array, "b f h w 3"], video: Float[Array, "b f h w 3"]
    ) -> jax.Array:
        """Return the mean squared error, weighted by motion."""
        if not self.motion_weight:
            return super().squared_error(decoded, video)
        return (motion_weights(video, self.motion_weight) * jnp.square(decoded - video)).mean()

    def decoding_loss(
        self,
        vae: Any,
        latents: Float[Array, "b f h w z"],
        video: Float[Array, "b f2 h2 w2 3"],
        key: Key[Array, ""],
    ) -> tuple[jax.Array, Metrics]:
        """Return the loss of decoding given latents, normalized ones, and its terms.

        The latents may be a denoiser's. LPIPS compares random frames.
        """
        decoded = vae.decode_whole(vae.denormalize(latents))
        loss, metrics = self.compare(decoded, video)
        return self._with_lpips(loss, metrics, decoded, video, key)

    def _with_lpips(
        self,
        loss: jax.Array,
        metrics: Metrics,
        decoded: Float[Array, "b f h w 3"],
        video: Float[Array, "b f h w 3"],
        key: Key[Array, ""],
    ) -> tuple[jax.Array, Metrics]:
        """Return loss and metrics with the perceptual term of random frames."""
        if not self.perceptual_weight:
            return loss, metrics
        count = self.perceptual_frames
        frames = jax.random.choice(key, self.video.frames, (count,), replace=False)
        distance = lpips(decoded[:, frames], video[:, frames]).mean()
        return loss + self.perceptual_weight * distance, {**metrics, "lpips": distance}

    def validate(self, networks: Networks, batch: Batch) -> Metrics:
        """Return PSNR and LPIPS of each clip, reconstructed from the mean latents."""
        vae: Any = networks.vae
        metrics = super().validate(vae, batch)
        if self.perceptual_weight:
            video = to_model(batch["video"])
            decoded = vae.decode_whole(vae.moments(video)[0])
            distances = lpips(decoded.clip(-1, 1), video)
            metrics["lpips"] = distances.reshape(video.shape[:2]).mean(axis=1)
        return metrics


def motion_weights(video: Float[Array, "b f h w 3"], weight: float) -> Float[Array, "b 1 h w 1"]:
    """Return the weight of each location of a video, with mean 1: higher at motion."""
    variance = video.var(axis=1, keepdims=True).mean(axis=-1, keepdims=True)
    weights = 1 + weight * jnp.minimum(variance / MOVING, 1)
    return weights / weights.mean(axis=(2, 3), keepdims=True)


def lpips(
    decoded: Float[Array, "b f h w 3"], video: Float[Array, "b f h w 3"]
) -> Float[Array, " n"]:
    """Return the distances of all b f frames."""
    images = (x.reshape(-1, *x.shape[2:]) for x in (decoded, video))
    return Lpips.load("alex")(*images)
