"""Networks in flax.nnx that do no I/O and know no mesh.

A network's config builds it and names its conversion table. A model (`networks.ModelConfig`) is a
choice of four such configs, so that a family is added by writing networks that satisfy the
Protocols of this module.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol, runtime_checkable

from flax import nnx
from jaxtyping import Array, Bool, Float, Int


@runtime_checkable
class Denoiser(Protocol):
    """Network that predicts noise, data or velocity from noisy latents."""

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
        """Return the prediction, in float32, for noisy latents at times in [0, 1000]."""
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
    """Config of a network, which builds it."""

    table: ClassVar[str]
    """Module whose `TABLE` maps its weights to the names of other formats (`convert.tables`)."""

    @property
    def dtype(self) -> str:
        """Compute dtype."""
        ...

    def build(self, *, rngs: nnx.Rngs) -> Any:
        """Build the network with random weights."""
        ...


def abstract(config: NetworkConfig) -> Any:
    """Build a config's network with shapes in place of weights."""
    return nnx.eval_shape(lambda: config.build(rngs=nnx.Rngs(0)))
