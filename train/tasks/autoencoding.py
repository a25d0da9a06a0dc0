"""Training of the video VAE from scratch: reconstruction, edge and KL terms.

For a clip x in [-1, 1] with moments mu, log s^2 and a sample z = mu + s e, e ~ N(0, 1), decoded
to y, the loss is

    (y - x)^2 + edge_weight * (|dx/du - dy/du| over rows and columns)
              + kl_weight * KL(N(mu, s^2) || N(0, 1))

Each term is a mean over its elements. The edge term keeps fingers and small objects, which the
squared error alone blurs first. The VAE trains on target, prior and hands, because all three are
encoded later.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Key

from egosim_jax.conditioning.pixels import to_model
from egosim_jax.models import VideoCodecConfig
from egosim_jax.train.task import Batch, Metrics
from egosim_jax.types import InputError, VideoSpec


@dataclass(frozen=True, kw_only=True)
class Autoencoding:
    """The task of training the video VAE on random crops of clips."""

    vae: VideoCodecConfig
    """Config of the VAE."""
    video: VideoSpec
    """Number of frames of a crop, and the size of the full videos."""
    crop: tuple[int, int] = (64, 64)
    """Rows and columns of a crop in pixels."""
    stream_probs: tuple[float, float, float] = (0.6, 0.25, 0.15)
    """Probabilities of a crop of the target, the prior and the hands."""
    edge_weight: float = 0.05
    """Weight of the edge term."""
    kl_weight: float = 5e-5
    """Weight of the KL term."""

    def __post_init__(self) -> None:
        for name, crop, size in zip(
            ("rows", "columns"), self.crop, (self.video.height, self.video.width), strict=True
        ):
            if crop % self.vae.spatial_stride or not 0 < crop <= size:
                raise InputError(
                    f"A crop of {crop} {name} cannot be cut out of {size}: it must be a multiple "
                    f"of {self.vae.spatial_stride} and at most the video's. (--crop)"
                )

    def networks(self, rngs: nnx.Rngs) -> Any:
        """Return the VAE with random weights."""
        return self.vae.build(rngs=rngs)

    @property
    def trained(self) -> Any:
        """The nnx filter of all weights."""
        return nnx.Param

    @property
    def frozen_dtype(self) -> str:
        """Unused: nothing is frozen."""
        return "float32"

    def examples(self) -> Any:
        """Return the transform that cuts a random crop out of a record."""
        from egosim_jax.data.transforms import RandomCrop

        return RandomCrop(self.video, self.crop, self.stream_probs)

    def shapes(self, batch: int) -> Mapping[str, jax.ShapeDtypeStruct]:
        """Return the shape of a batch of crops."""
        shape = (batch, self.video.frames, *self.crop, 3)
        return {"video": jax.ShapeDtypeStruct(shape, np.uint8)}

    def keys(self, key: Key[Array, ""], batch: int) -> Key[Array, " b"]:
        """Return a key per sample; the first one draws the noise of the batch."""
        others = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(1, batch))
        return jnp.concatenate([key[None], others])

    def loss(
        self, networks: Any, batch: Batch, keys: Key[Array, " b"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the loss of the module docstring, for sampled latents."""
        _, loss, metrics = self.reconstruct(networks, to_model(batch["video"]), keys[0])
        return loss, metrics

    def reconstruct(
        self, vae: Any, video: Float[Array, "b f h w 3"], key: Key[Array, ""]
    ) -> tuple[Float[Array, "b f h w 3"], jax.Array, Metrics]:
        """Return the reconstruction of a video from sampled latents, its loss and its terms."""
        mean, logvar = vae.moments(video)
        latents = mean + jnp.exp(logvar / 2) * jax.random.normal(key, mean.shape)
        decoded = vae.decode_whole(latents)
        loss, metrics = self.compare(decoded, video)
        kl = 0.5 * (jnp.square(mean) + jnp.exp(logvar) - 1 - logvar).mean()
        return decoded, loss + self.kl_weight * kl, {**metrics, "kl": kl}

    def compare(
        self, decoded: Float[Array, "b f h w 3"], video: Float[Array, "b f h w 3"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the loss of decoded frames, without the latents' term, and its terms."""
        mse, edge_loss = self.squared_error(decoded, video), _edge_error(decoded, video)
        metrics = {"mse": mse, "edge_loss": edge_loss, "psnr": psnr(decoded, video).mean()}
        return mse + self.edge_weight * edge_loss, metrics

    def squared_error(
        self, decoded: Float[Array, "b f h w 3"], video: Float[Array, "b f h w 3"]
    ) -> jax.Array:
        """Return the mean squared error of a reconstruction."""
        return jnp.square(decoded - video).mean()

    def flops(self, samples: int) -> float:
        """Return NaN: not counted."""
        return float("nan")

    def validate(self, networks: Any, batch: Batch) -> Metrics:
        """Return the PSNR of each clip's reconstruction from the mean latents."""
        video = to_model(batch["video"])
        decoded = networks.decode_whole(networks.moments(video)[0])
        return {"psnr": psnr(decoded, video)}


def _edge_error(a: Float[Array, "b f h w 3"], b: Float[Array, "b f h w 3"]) -> jax.Array:
    difference = a - b
    rows = jnp.abs(difference[:, :, 1:] - difference[:, :, :-1]).mean()
    columns = jnp.abs(difference[:, :, :, 1:] - difference[:, :, :, :-1]).mean()
    return rows + columns


def psnr(
    decoded: Float[Array, "b f h w 3"], video: Float[Array, "b f h w 3"]
) -> Float[Array, " b"]:
    """Return the PSNR of each clip in dB, of float frames clipped to [-1, 1]."""
    error = jnp.square(jnp.clip(decoded, -1, 1) - video).mean(axis=(1, 2, 3, 4))
    return 10 * jnp.log10(4.0 / jnp.maximum(error, 1e-10))


def latent_statistics(vae: Any, videos: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of each latent channel over uint8 videos `f h w 3`."""
    graph, params = nnx.split(vae)

    @jax.jit
    def sums(params: Any, video: jax.Array) -> jax.Array:
        mean, _ = nnx.merge(graph, params).moments(to_model(video)[None])
        return jnp.stack([mean.mean((0, 1, 2, 3)), jnp.square(mean).mean((0, 1, 2, 3))])

    first, second = np.mean([np.asarray(sums(params, video)) for video in videos], axis=0)
    return first, np.sqrt(second - first**2)
