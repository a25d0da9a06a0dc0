"""Networks in flax.nnx, and the Protocols that every network satisfies.

Networks do no I/O and know no mesh. A network's config builds it and names its conversion table; a
`configs.model.ModelConfig` combines four of them, so a family is added by writing networks that
satisfy the Protocols of this module.

    Denoiser, VideoCodec, TextEncoder, ImageEncoder   networks
    DenoiserConfig, VideoCodecConfig, ...             their configs
    CausalDenoiser, Chunks                            denoiser of one chunk of a clip at a time
    wan, cogvideox                                    model families
    lora                                              low-rank adaptation
    eight_bit                                         linear layers with weights in 8 bits
"""

from __future__ import annotations

import functools
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from egosim_jax.models.chunks import Chunks


@runtime_checkable
class Denoiser(Protocol):
    """Network that predicts noise, data, velocity or v from noisy latents (`Process`)."""

    def prepare(
        self,
        condition: Float[Array, "b f h w c"],
        text: Float[Array, "b n d"],
        image: Float[Array, "b m e"] | None = None,
    ) -> Any:
        """Compute the context that all denoising steps share.

        `condition` holds the input channels after the noisy ones.
        """
        ...

    def denoise(
        self, noisy: Float[Array, "b f h w c"], t: Float[Array, " b"], context: Any
    ) -> Float[Array, "b f h w c"]:
        """Return the prediction, in float32, for noisy latents at timesteps `t`.

        `Process.timesteps` returns them.
        """
        ...


@runtime_checkable
class HalfGridDenoiser(Denoiser, Protocol):
    """Denoiser that can also run on half the rows and columns of its latent grid.

    Its config has a true `half_grid`.
    """

    def prepare_half(
        self,
        condition: Float[Array, "b f h w c"],
        text: Float[Array, "b n d"],
        image: Float[Array, "b m e"] | None = None,
    ) -> Any:
        """Compute the context of steps on the half grid, as `prepare` does."""
        ...


@runtime_checkable
class CausalDenoiser(Denoiser, Protocol):
    """Denoiser that can also make a clip chunk by chunk, from the chunks before."""

    def share(self, text: Float[Array, "b n d"], image: Float[Array, "b m e"] | None = None) -> Any:
        """Compute what the chunks of a clip share."""
        ...

    def prepare_chunk(
        self, condition: Float[Array, "b f h w c"], shared: Any, first_frame: int
    ) -> Any:
        """Compute the context that all denoising steps of a chunk share.

        The chunk begins at the latent frame `first_frame` of the clip.
        """
        ...

    def empty_cache(self, batch: int, latents: tuple[int, int, int]) -> Cache:
        """Return the cache with which the first chunk of clips of a size is denoised."""
        ...

    def denoise_chunk(
        self, noisy: Float[Array, "b f h w c"], t: Float[Array, " b"], context: Any, cache: Any
    ) -> tuple[Float[Array, "b f h w c"], Any]:
        """Return the prediction for the next chunk, and what later chunks need of it.

        Raises `InputError` for a cache that does not end where the chunk begins.
        """
        ...

    def denoise_packed(
        self,
        clean: Float[Array, "b f h w c"],
        noisy: Float[Array, "b f h w c"],
        t: Float[Array, "b k"],
        context: Any,
        chunks: Chunks,
    ) -> Float[Array, "b f h w c"]:
        """Return the prediction for all chunks, each from the clean chunks before it.

        Each chunk has its own timestep. `prepare` returns the context.
        """
        ...


class Cache(Protocol):
    """Memory of a causal denoiser, of the finished chunks of a clip; a pytree."""

    def put(self, chunk: Any) -> Cache:
        """Return the cache with one more chunk, by the second result of `denoise_chunk`."""
        ...


@runtime_checkable
class VideoCodec(Protocol):
    """Video autoencoder; RGB in [-1, 1] to normalized latents and back."""

    def encode(self, video: Float[Array, "b f h w 3"]) -> Float[Array, "b f2 h2 w2 z"]:
        """Return the normalized mean latents, in float32."""
        ...

    def decode(self, latents: Float[Array, "b f h w z"]) -> Float[Array, "b f2 h2 w2 3"]:
        """Return the video of normalized latents, in float32 and clipped to [-1, 1]."""
        ...

    def moments(
        self, video: Float[Array, "b f h w 3"]
    ) -> tuple[Float[Array, "b f2 h2 w2 z"], Float[Array, "b f2 h2 w2 z"]]:
        """Return mean and log variance of the latents, before normalization."""
        ...


@runtime_checkable
class TextEncoder(Protocol):
    """Encoder of prompts."""

    def __call__(self, ids: Int[Array, "b n"], mask: Bool[Array, "b n"]) -> Float[Array, "b n d"]:
        """Return the embeddings of token ids; `mask` is True on the prompt's tokens."""
        ...


@runtime_checkable
class ImageEncoder(Protocol):
    """Encoder of the first frame."""

    def __call__(self, pixels: Float[Array, "b s s 3"]) -> Float[Array, "b m e"]:
        """Return the tokens of normalized pixels."""
        ...


@runtime_checkable
class NetworkConfig(Protocol):
    """Config of a network, a frozen dataclass that builds it."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    table: ClassVar[str]
    """Module whose `TABLE` maps its weights to the names of other formats (`convert.tables`)."""

    @property
    def dtype(self) -> str:
        """Dtype that the network computes in."""
        ...

    def build(self, *, rngs: nnx.Rngs) -> Any:
        """Build the network with random weights."""
        ...


@runtime_checkable
class DenoiserConfig(NetworkConfig, Protocol):
    """Config of a denoiser."""

    numerics_only: ClassVar[tuple[str, ...]]
    """Fields that change only how values are computed, which a resumed training may change."""
    remat_levels: ClassVar[tuple[str, ...]]
    """Values of the field `remat`, by the memory that they take, ascending; empty without it."""
    lora_targets: ClassVar[tuple[str, ...]]
    """Patterns of the linear layers that a LoRA adapts, by dotted path."""
    also_train: ClassVar[tuple[str, ...]]
    """Patterns of the weights that are trained in full along with a LoRA, by dotted path."""

    @property
    def in_channels(self) -> int:
        """Channels of the noisy latents and the condition together."""
        ...

    @property
    def out_channels(self) -> int:
        """Channels of the noisy latents and of the prediction."""
        ...

    @property
    def patch(self) -> tuple[int, int, int]:
        """Latent frames, rows and columns of a token."""
        ...

    @property
    def heads(self) -> int:
        """Number of attention heads of the denoiser."""
        ...

    @property
    def text_dim(self) -> int:
        """Width of the text encoder's tokens."""
        ...

    @property
    def image_dim(self) -> int | None:
        """Width of the image encoder's tokens; None for a model without the image branch."""
        ...

    def forward_flops(self, *, latents: tuple[int, int, int], text: int, image: int) -> Flops:
        """Return the FLOPs of a forward pass of one sample, by its latent cells and tokens."""
        ...


@runtime_checkable
class CausalDenoiserConfig(Protocol):
    """Config of a denoiser that is a `CausalDenoiser`, in addition to `DenoiserConfig`."""

    def packed_flops(
        self, *, latents: tuple[int, int, int], chunks: Chunks, text: int, image: int
    ) -> Flops:
        """Return the FLOPs of a forward pass of all chunks of one sample (`denoise_packed`)."""
        ...

    def chunk_flops(
        self, *, latents: tuple[int, int, int], seen: int, text: int, image: int
    ) -> Flops:
        """Return the FLOPs of a step of one chunk (`denoise_chunk`), after `seen` latent frames."""
        ...


@runtime_checkable
class VideoCodecConfig(NetworkConfig, Protocol):
    """Config of a video codec."""

    @property
    def spatial_stride(self) -> int:
        """Pixels per latent cell, along each axis."""
        ...

    @property
    def temporal_stride(self) -> int:
        """Pixel frames per latent frame, after the first."""
        ...

    @property
    def latent_channels(self) -> int:
        """Channels of the latents."""
        ...


@runtime_checkable
class ChunkedCodecConfig(Protocol):
    """Config of a video codec that supports only some of the lengths that its strides allow."""

    def check_frames(self, frames: int) -> None:
        """Raise `InputError` for a number of frames that the codec does not support."""
        ...


@runtime_checkable
class TextEncoderConfig(NetworkConfig, Protocol):
    """Config of a text encoder."""

    @property
    def dim(self) -> int:
        """Width of the embeddings."""
        ...


@runtime_checkable
class ImageEncoderConfig(NetworkConfig, Protocol):
    """Config of an image encoder."""

    @property
    def dim(self) -> int:
        """Width of the tokens."""
        ...

    @property
    def image_size(self) -> int:
        """Rows and columns of the image in pixels."""
        ...

    @property
    def tokens(self) -> int:
        """Tokens of an image."""
        ...


class Flops(NamedTuple):
    """Model FLOPs of a forward pass; a multiplication and an addition count as two."""

    weights: float
    """FLOPs of products with weights."""
    attention: float
    """FLOPs of products of queries, keys and values."""

    @property
    def total(self) -> float:
        """FLOPs of weights and attention together."""
        return self.weights + self.attention


def abstract(config: NetworkConfig) -> Any:
    """Build a config's network with shapes in place of weights."""
    return nnx.clone(_traced(config))


@functools.cache
def _traced(config: NetworkConfig) -> Any:
    """Trace the construction, which takes a second, once; callers get copies."""
    return nnx.eval_shape(lambda: config.build(rngs=nnx.Rngs(0)))
