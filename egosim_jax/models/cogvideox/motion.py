"""CogVideoX's transformer with hand poses in its modulation, the ablation "AdaLN" of DWM.

The poses of the hands, a vector for each pixel frame, are embedded and change shift, scale and gate
of every block. Video tokens use the poses of their latent frame (`frame`), or the mean of all poses
(`global`); text tokens use the mean. The addition is 0 before training.

The released class for single frames averages them too, and initializes its embedding with 0, so it
never learns. Here only the last layer starts at 0. (Kim et al. 2026, table 3.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal, no_type_check

import jax
import jax.numpy as jnp
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float, Int

from egosim_jax.models import Flops
from egosim_jax.models.cogvideox.dit import CogVideoXContext, CogVideoXDiT, CogVideoXDiTConfig
from egosim_jax.models.cogvideox.layers import MLP, Attention, Block, Modulation
from egosim_jax.models.layers import LayerNorm, Linear, zeros
from egosim_jax.types import InputError, check_counts

TAPS = 3
"""Frames that a convolution over time sees."""


@dataclass(frozen=True, kw_only=True)
class MotionDiTConfig(CogVideoXDiTConfig):
    """Shape of a transformer that hand poses modulate."""

    also_train: ClassVar[tuple[str, ...]] = ("patch.*", "motion.*", "blocks.*.pose.*")
    """Patterns of the weights that are trained in full along with a LoRA."""

    pose_dim: int = 128
    """Numbers of the hands' poses in a pixel frame."""
    frames: Literal["frame", "global"] = "frame"
    """Poses that modulate a token: its latent frame's poses, or the mean over the clip."""

    def __post_init__(self) -> None:
        """Check the sizes."""
        super().__post_init__()
        check_counts({"pose_dim": self.pose_dim})

    def build(self, *, rngs: nnx.Rngs) -> MotionDiT:
        """Build the network with random weights."""
        return MotionDiT(self, rngs=rngs)

    def forward_flops(self, *, latents: tuple[int, int, int], text: int, image: int) -> Flops:
        """Return the FLOPs of a forward pass of one sample, with poses of `image` pixel frames.

        To CogVideoX's, with P poses of width p, F latent frames, a time embedding of width e and L
        blocks of width d, they add

            embedding     2 P e (p + e) + 6 e^2 (convolved frames of both convolutions)
            modulation    L 24 e d (F + 1)
        """
        base = super().forward_flops(latents=latents, text=text, image=0)
        frames, e = latents[0], self.time_dim
        convolved = 3 * frames if self.frames == "frame" else 2 * image
        embedding = 2 * image * e * (self.pose_dim + e) + 6 * e**2 * convolved
        rows = frames + 1  # of the poses of each latent frame, and of their mean
        modulation = self.layers * 24 * e * self.dim * rows
        return base._replace(weights=base.weights + embedding + modulation)

    @property
    def image_dim(self) -> int:
        """Width of the tokens in the place of an image's: the poses of a pixel frame."""
        return self.pose_dim


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class MotionContext(CogVideoXContext):
    """Context that all denoising steps share, with the hands' poses."""

    motion: Float[Array, "b f e"]
    """Embeddings of the poses of each latent frame, then their mean."""
    frame: Int[Array, " n"]
    """Row of `motion` of each token."""


class Motion(nnx.Module):
    """Embedding of poses: an MLP for each pixel frame, then convolutions over time."""

    def __init__(self, config: MotionDiTConfig, *, rngs: nnx.Rngs):
        dim, dtype = config.time_dim, config.dtype

        def linear(width: int) -> Linear:
            return Linear(width, dim, axes=(None, None), dtype=dtype, rngs=rngs)

        self.frames = config.frames
        self.up, self.down = linear(config.pose_dim), linear(dim)
        self.first, self.second = linear(TAPS * dim), linear(TAPS * dim)
        self.norm = LayerNorm(dim, eps=config.eps, axes=(None,))

    def __call__(self, poses: Float[Array, "b f p"]) -> Float[Array, "b g e"]:
        """Embed the poses of 4k+1 pixel frames: k+1 latent frames, or one for all."""
        x = self.down(jax.nn.silu(self.up(poses)))
        stride = 2 if self.frames == "frame" else 1
        if self.frames == "frame":  # the first latent frame encodes one pixel frame only
            x = jnp.concatenate([jnp.repeat(x[:, :1], 3, axis=1), x], axis=1)
        x = jax.nn.silu(self.first(windows(x, stride)))
        x = self.second(windows(x, stride))
        return self.norm(x if self.frames == "frame" else x.mean(axis=1, keepdims=True))


def windows(x: Float[Array, "b f e"], stride: int) -> Float[Array, "b g w"]:
    """Return each frame with its neighbors, every `stride`-th from the first; 0 outside."""
    count = x.shape[1]
    padded = jnp.pad(x, ((0, 0), (1, 1), (0, 0)))
    taps = [padded[:, i : i + count : stride] for i in range(TAPS)]
    return jnp.concatenate(taps, axis=-1)


class PoseModulation(Modulation):
    """Layer norm with vectors from the time embedding and from poses, which start at 0."""

    def __init__(self, config: MotionDiTConfig, n: int, *, rngs: nnx.Rngs):
        super().__init__(config, n, rngs=rngs)
        self.pose = Linear(
            config.time_dim,
            n * config.dim,
            axes=(None, "embed"),
            dtype=config.dtype,
            kernel_init=zeros,
            rngs=rngs,
        )

    def vectors(self, time: Any) -> Float[Array, "n b m d"]:
        """Return the vectors of all tokens, in float32.

        `time` holds the time embedding, the embeddings of the poses and the row of each token.
        """
        embedding, motion, frame = time
        poses = self.pose(jax.nn.silu(motion)).astype(jnp.float32)
        poses = rearrange(poses, "b f (n d) -> n b f d", n=self.n)
        return super().vectors(embedding) + jnp.take(poses, frame, axis=2)


class PoseBlock(Block):
    """Transformer block whose modulations see the poses."""

    def __init__(self, config: MotionDiTConfig, *, rngs: nnx.Rngs):
        nnx.Module.__init__(self)
        self.modulation_a = PoseModulation(config, 6, rngs=rngs)
        self.attn = Attention(config, rngs=rngs)
        self.modulation_m = PoseModulation(config, 6, rngs=rngs)
        self.mlp = MLP(config, rngs=rngs)


class MotionDiT(CogVideoXDiT):
    """Video diffusion transformer that hand poses modulate."""

    config: MotionDiTConfig
    block = PoseBlock

    def __init__(self, config: MotionDiTConfig, *, rngs: nnx.Rngs):
        super().__init__(config, rngs=rngs)
        self.motion = Motion(config, rngs=rngs)

    def prepare(
        self,
        condition: Float[Array, "b f h w c"],
        text: Float[Array, "b m e"],
        image: Float[Array, "b k i"] | None = None,
    ) -> MotionContext:
        """Compute the context that all denoising steps share; `image` holds the poses.

        Raises `InputError` for other channels and sizes, or without the poses of all pixel frames.
        """
        frames = condition.shape[1]
        want = 4 * (frames - 1) + 1
        if image is None or image.shape[1] != want:
            raise InputError(
                f"{0 if image is None else image.shape[1]} poses of hands were given for {frames} "
                f"latent frames: there must be one for each of the {want} pixel frames. (tokens)"
            )
        base = super().prepare(condition, text)
        motion = self.motion(image)
        if self.config.frames == "global":
            motion = jnp.repeat(motion, frames, axis=1)
        motion = jnp.concatenate([motion, motion.mean(axis=1, keepdims=True)], axis=1)
        cells = (len(base.rotation) - text.shape[1]) // frames
        texts = jnp.full(text.shape[1], frames)
        frame = jnp.concatenate([texts, jnp.repeat(jnp.arange(frames), cells)])
        return MotionContext(**vars(base), motion=motion, frame=frame)

    def modulators(self, time: Float[Array, "b e"], context: CogVideoXContext) -> Any:
        """Return the time embedding with the poses and the row of each token."""
        motion: Any = context
        return time, motion.motion, motion.frame
