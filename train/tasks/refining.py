"""Training a video VAE further, with a term that compares as eyes do and more weight on motion.

LPIPS (`evaluation/metrics/lpips.py`, AlexNet) is added to the loss of `autoencoding` between some
frames of the crop and of its reconstruction:

    perceptual_weight * mean over frames of LPIPS(y_t, x_t)

The squared error is smallest for the mean of all that a latent cell may stand for, which is a
blur; LPIPS is smaller for any one of them. The decoder can be trained alone, which leaves the
latents as they are, and with them denoisers that were trained on them.

Hands and what they carry cover little of a frame and are the hardest to reconstruct: a latent cell
stands for four frames, in which they have moved on. The squared error may therefore weight places
by their motion, the variance v of their colors over the frames of the crop:

    1 + motion_weight * min(v / MOVING, 1),   divided by its mean over the crop
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int, Key

from egosim_jax.conditioning.pixels import to_model
from egosim_jax.configs.model import Networks
from egosim_jax.evaluation.metrics.lpips import Lpips
from egosim_jax.train.tasks.autoencoding import Autoencoding
from egosim_jax.train.update import Batch, Metrics
from egosim_jax.types import InputError

Part = Literal["all", "decoder"]
"""Weights of a VAE that are trained."""
DECODER = ("decoder", "from_latents")
"""Modules that decode latents."""
MOVING = 0.02
"""Variance over time of the colors, in [-1, 1], of a place that counts as fully moving."""
SMALLEST = 32
"""Fewest rows and columns of a crop of which AlexNet's last layers see anything."""


@dataclass(frozen=True, kw_only=True)
class Refining(Autoencoding):
    """The task of training the VAE of a weights folder further."""

    perceptual_weight: float = 0.1
    """Weight of the perceptual term; above 0 it needs egosim-jax[metrics]."""
    perceptual_frames: int = 4
    """Frames of a crop that the perceptual term compares, drawn at random."""
    motion_weight: float = 0.0
    """Additional weight of the squared error where something moves."""
    part: Part = "all"
    """Weights that are trained; decoder: the latents stay as they are."""

    def __post_init__(self) -> None:
        """Check what the perceptual term compares, too."""
        super().__post_init__()
        if self.perceptual_weight and min(self.crop) < SMALLEST:
            raise InputError(
                f"A crop of {self.crop[0]} x {self.crop[1]} pixels is too small for LPIPS: it must "
                f"have at least {SMALLEST} rows and columns, or --perceptual-weight be 0. (--crop)"
            )
        if not 0 < self.perceptual_frames <= self.video.frames:
            raise InputError(
                f"The perceptual term must compare 1 to {self.video.frames} frames, which a crop "
                f"has, not {self.perceptual_frames}. (--perceptual-frames)"
            )

    def networks(self, rngs: nnx.Rngs) -> Networks:
        """Return the VAE with random weights, under its name."""
        return Networks(vae=super().networks(rngs))

    @property
    def trained(self) -> Any:
        """The nnx filter of all weights, or of those of the decoder."""
        if self.part == "all":
            return nnx.Param
        return lambda path, value: isinstance(value, nnx.Param) and path[1] in DECODER

    def loss(
        self, networks: Networks, batch: Batch, keys: Key[Array, " b"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the loss of the module docstring, for sampled latents."""
        draw = jax.random.fold_in(keys[0], 1)
        frames = jax.random.choice(
            draw, self.video.frames, (self.perceptual_frames,), replace=False
        )
        _, loss, metrics = self.perceived(networks.vae, to_model(batch["video"]), keys[0], frames)
        return loss, metrics

    def squared_error(
        self, decoded: Float[Array, "b f h w 3"], video: Float[Array, "b f h w 3"]
    ) -> jax.Array:
        """Return the mean squared error, weighted by motion."""
        if not self.motion_weight:
            return super().squared_error(decoded, video)
        return (motion_weights(video, self.motion_weight) * jnp.square(decoded - video)).mean()

    def perceived(
        self,
        vae: Any,
        video: Float[Array, "b f h w 3"],
        key: Key[Array, ""],
        frames: Int[Array, " n"],
    ) -> tuple[Float[Array, "b f h w 3"], jax.Array, Metrics]:
        """Return what `reconstruct` does, with the perceptual term of some frames in the loss."""
        decoded, loss, metrics = self.reconstruct(vae, video, key)
        if self.perceptual_weight:
            metrics["lpips"] = _lpips(decoded[:, frames], video[:, frames]).mean()
            loss = loss + self.perceptual_weight * metrics["lpips"]
        return decoded, loss, metrics

    def validate(self, networks: Networks, batch: Batch) -> Metrics:
        """Return PSNR and LPIPS of each clip's reconstruction from the mean latents."""
        vae: Any = networks.vae
        metrics = super().validate(vae, batch)
        if self.perceptual_weight:
            video = to_model(batch["video"])
            decoded = vae.decode_whole(vae.moments(video)[0])
            distances = _lpips(decoded.clip(-1, 1), video)
            metrics["lpips"] = distances.reshape(video.shape[:2]).mean(axis=1)
        return metrics


def motion_weights(video: Float[Array, "b f h w 3"], weight: float) -> Float[Array, "b 1 h w 1"]:
    """Return the weight of each place of a video, with mean 1: more where something moves."""
    variance = video.var(axis=1, keepdims=True).mean(axis=-1, keepdims=True)
    weights = 1 + weight * jnp.minimum(variance / MOVING, 1)
    return weights / weights.mean(axis=(2, 3), keepdims=True)


def _lpips(
    decoded: Float[Array, "b f h w 3"], video: Float[Array, "b f h w 3"]
) -> Float[Array, " n"]:
    """Return the distances of all b f frames."""
    images = (x.reshape(-1, *x.shape[2:]) for x in (decoded, video))
    return Lpips.load("alex").compare(*images)
