"""Video diffusion transformer of Wan 2.1, in all its published shapes, and EgoSim's.

Noisy latents of 16 channels and a condition of 0 (text to video), 20 (image to video) or 36
channels (EgoSim) are split into patches of 1 x 2 x 2 cells, one token each, which pass through the
blocks of `layers` and become the velocity of the noisy latents.

Everything that does not depend on the step is computed once by `prepare`: the patch embedding is
linear, so the condition's contribution is separate; keys and values of the cross-attentions depend
on text and image only. A solver calls `denoise` at each step.

A causal student has the same weights, and makes a clip chunk by chunk (`causal`): `share` computes
what the chunks share, `prepare_chunk` the context of one chunk, and `denoise_chunk` is a step of
it. Training denoises all chunks at once, by `denoise_packed`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import prod
from typing import Any, ClassVar, no_type_check

import jax
import jax.numpy as jnp
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models import Flops, remat, rope
from egosim_jax.models.chunks import Chunks
from egosim_jax.models.layers import scan_blocks, stack
from egosim_jax.models.patch import PatchEmbedding
from egosim_jax.models.wan.causal import CACHE, KeyValueCache, by_run, cached, packed, whole
from egosim_jax.models.wan.layers import (
    MLP,
    PATCH,
    Attend,
    Block,
    CrossAttention,
    Head,
    ImageEmbedding,
    KeysValues,
    TimeEmbedding,
    WanDiTSizes,
    gelu_tanh,
    normal,
)
from egosim_jax.sharding import constrain
from egosim_jax.types import InputError

TOKENS, VECTORS = ("batch", "tokens", None), ("batch", None, None)
"""Logical axes of the residual stream, and of arrays that all tokens share."""


@dataclass(frozen=True, kw_only=True)
class WanDiTConfig(WanDiTSizes):
    """Config of the transformer; the defaults are EgoSim's 14B."""

    table: ClassVar[str] = "egosim_jax.convert.tables.wan_dit"
    """Module of the conversion table."""
    numerics_only: ClassVar[tuple[str, ...]] = ("dtype", "products", "attention", "remat")
    """Fields that change only how values are computed, which a resumed training may change."""
    remat_levels: ClassVar[tuple[str, ...]] = remat.LEVELS
    """Values of `remat`, by the memory that they take, ascending."""
    lora_targets: ClassVar[tuple[str, ...]] = ("blocks.*",)
    """Patterns of the linear layers that a LoRA adapts."""
    also_train: ClassVar[tuple[str, ...]] = ()
    """Patterns of the weights that are trained in full along with a LoRA."""
    half_grid: ClassVar[bool] = True
    """Mark of a `HalfGridDenoiser`."""

    def build(self, *, rngs: nnx.Rngs) -> WanDiT:
        """Build the network with random weights."""
        return WanDiT(self, rngs=rngs)

    def forward_flops(self, *, latents: tuple[int, int, int], text: int, image: int) -> Flops:
        """Return the FLOPs of a forward pass of one sample, by its latent cells and tokens.

        With N tokens of width d, an MLP of width f, T text and I image tokens and L blocks, it has

            self-attention    L (8 N d^2 + 4 N^2 d)
            cross-attention   L (4 N d^2 + 4 (T + I) d^2 + 4 N (T + I) d)
            MLP               L 4 N d f

        and the embeddings and the head. Norms and activations do not count.
        """
        n = prod(latents) // PATCH**2
        return self._flops(n, pairs=n * n, text=text, image=image, conditioned=n)

    def packed_flops(
        self, *, latents: tuple[int, int, int], chunks: Chunks, text: int, image: int
    ) -> Flops:
        """Return the FLOPs of a forward pass of all chunks of one sample (`denoise_packed`).

        The formulas of `forward_flops` hold with N clean and noisy tokens, and with the number of
        pairs of a query and a key in place of N^2.
        """
        tokens = prod(latents[1:]) // PATCH**2
        clean = chunks.bounds[-2]
        ends = zip(chunks.sizes, chunks.bounds[1:], strict=True)
        seen = [size * end for size, end in ends]
        return self._flops(
            (clean + latents[0]) * tokens,
            pairs=(sum(seen) + sum(seen[:-1])) * tokens**2,
            text=text,
            image=image,
            conditioned=latents[0] * tokens,
            times=1 + len(seen) if clean else 1,
        )

    def chunk_flops(
        self, *, latents: tuple[int, int, int], seen: int, text: int, image: int
    ) -> Flops:
        """Return the FLOPs of a step of one chunk (`denoise_chunk`), after `seen` latent frames.

        Keys and values of text and image, and the condition's patches, are given.
        """
        tokens = prod(latents[1:]) // PATCH**2
        n = latents[0] * tokens
        pairs = n * (n + seen * tokens)
        return self._flops(n, pairs=pairs, text=text, image=image, is_shared=True)

    def _flops(
        self,
        n: int,
        *,
        pairs: int,
        text: int,
        image: int,
        conditioned: int = 0,
        times: int = 1,
        is_shared: bool = False,
    ) -> Flops:
        """Return the FLOPs of n tokens; `conditioned` is the number that embed the condition."""
        d, f, depth = self.dim, self.ffn_dim, self.layers
        image = image if self.image_dim is not None else 0
        weights = depth * (12 * n * d**2 + 4 * n * d * f)
        noisy, condition = 2 * self.out_channels, self.in_channels - self.out_channels
        weights += 2 * PATCH**2 * (n * noisy + conditioned * condition) * d
        weights += 2 * times * (self.freq_dim * d + 7 * d**2)
        if not is_shared:
            weights += depth * 4 * (text + image) * d**2 + 2 * text * (self.text_dim * d + d**2)
            if self.image_dim is not None:
                weights += 2 * image * (self.image_dim**2 + self.image_dim * d)
        attention = depth * 4 * (pairs + n * (text + image)) * d
        return Flops(weights=float(weights), attention=float(attention))

    @property
    def patch(self) -> tuple[int, int, int]:
        """Latent frames, rows and columns of a token."""
        return 1, PATCH, PATCH


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class DiTContext:
    """Context that all denoising steps share."""

    patches: Float[Array, "b n d"]
    """Contribution of the condition to the patch embedding, with the bias."""
    sources: tuple[KeysValues, ...]
    """Cross-attention keys and values of all layers: of the text, then of the image if any."""
    rotation: Float[Array, "n k 2"]
    """Rotary embedding table of the tokens."""
    first_frame: int = field(default=0, metadata={"static": True})
    """Latent frame of the clip at which the tokens begin."""


class WanDiT(nnx.Module):
    """Video diffusion transformer: velocity of noisy latents, given condition, text and image."""

    def __init__(self, config: WanDiTConfig, *, rngs: nnx.Rngs):
        self.config = config
        self.patch = PatchEmbedding(config, patch=PATCH, rngs=rngs)
        self.time = TimeEmbedding(config, rngs=rngs)
        sizes = (config.text_dim, config.dim, config.dim)
        self.text = MLP(config, sizes, gelu_tanh, init=normal, rngs=rngs)
        width = config.image_dim
        self.image = None if width is None else ImageEmbedding(config, width, rngs=rngs)
        self.blocks = stack(lambda rngs: Block(config, rngs=rngs), config.layers, rngs=rngs)
        self.head = Head(config, rngs=rngs)

    def prepare(
        self,
        condition: Float[Array, "b f h w c"],
        text: Float[Array, "b n e"],
        image: Float[Array, "b m i"] | None = None,
    ) -> DiTContext:
        """Compute the context that all denoising steps share.

        `condition` holds the channels after the noisy ones (none for text to video), `text` the
        text encoder's tokens, `image` the image encoder's, for models with the image branch.
        """
        self.patch.check(condition.shape)
        return self.prepare_chunk(condition, self.share(text, image), 0)

    def prepare_half(
        self,
        condition: Float[Array, "b f h w c"],
        text: Float[Array, "b n e"],
        image: Float[Array, "b m i"] | None = None,
    ) -> DiTContext:
        """Compute the context of steps on half the rows and columns, by the condition there.

        Its tokens have the positions of the 2 x 2 tokens of the whole grid that they replace.
        """
        context = self.prepare(condition, text, image)
        _, f, h, w, _ = condition.shape
        rotation = rope.rotations(f, h // PATCH, w // PATCH, self.config.head_dim, side=2)
        return replace(context, rotation=rotation)

    def share(
        self, text: Float[Array, "b n e"], image: Float[Array, "b m i"] | None = None
    ) -> tuple[KeysValues, ...]:
        """Compute the keys and values of text and image, which the chunks of a clip share."""
        self._check_image(has_image=image is not None)
        tokens = [self.text(text)]
        if self.image is not None and image is not None:
            tokens.append(self.image(image))

        def step(layer: CrossAttention, x: None, _: None) -> tuple:
            branches = zip(layer.branches, tokens, strict=True)
            return x, tuple(branch.keys_values(y) for branch, y in branches)

        _, sources = scan_blocks(
            step, self.blocks.cross_attn, None, remat=remat.wrapper(self.config.remat)
        )
        return sources

    def prepare_chunk(
        self,
        condition: Float[Array, "b f h w c"],
        shared: tuple[KeysValues, ...],
        first_frame: int,
    ) -> DiTContext:
        """Compute the context that all denoising steps of a chunk share, by its condition."""
        self.patch.check(condition.shape)
        _, f, h, w, _ = condition.shape
        sizes = h // PATCH, w // PATCH, self.config.head_dim
        before = first_frame * sizes[0] * sizes[1]
        return DiTContext(
            patches=self.patch.condition(condition),
            sources=shared,
            rotation=rope.rotations(first_frame + f, *sizes)[before:],
            first_frame=first_frame,
        )

    def denoise(
        self, noisy: Float[Array, "b f h w c"], t: Float[Array, " b"], context: DiTContext
    ) -> Float[Array, "b f h w c"]:
        """Return the velocity, in float32, of noisy latents at timesteps in [0, 1000]."""
        x = self.patch.noisy(noisy) + context.patches
        attend = whole(self.config.attention)
        tokens, _ = self._through(x, t[:, None], context, lambda past: attend)
        return _unpatched(tokens, noisy.shape)

    def denoise_packed(
        self,
        clean: Float[Array, "b f h w c"],
        noisy: Float[Array, "b f h w c"],
        t: Float[Array, "b k"],
        context: DiTContext,
        chunks: Chunks,
    ) -> Float[Array, "b f h w c"]:
        """Return the velocity of noisy latents, each chunk's from the clean chunks before it.

        Each chunk has its own timestep. `context` is the context of the clip.
        """
        chunks.check(noisy.shape[1])
        seen = chunks.bounds[-2]
        tokens = context.patches.shape[1] // noisy.shape[1]
        both = jnp.concatenate([clean[:, :seen], noisy], axis=1)
        before = slice(seen * tokens)
        patches = jnp.concatenate([context.patches[:, before], context.patches], axis=1)
        rotation = jnp.concatenate([context.rotation[before], context.rotation])
        lengths = [size * tokens for size in (seen, *chunks.sizes) if size]
        if seen:
            t = jnp.concatenate([jnp.zeros_like(t[:, :1]), t], axis=1)
        attend = packed([bound * tokens for bound in chunks.bounds], self.config.attention)
        x, _ = self._through(
            self.patch.noisy(both) + patches,
            t,
            replace(context, rotation=rotation),
            lambda past: attend,
            lengths=lengths,
        )
        return _unpatched(x, both.shape)[:, seen:]

    def empty_cache(self, batch: int, latents: tuple[int, int, int]) -> KeyValueCache:
        """Return room for the self-attention keys and values of clips of a size."""
        config = self.config
        tokens = prod(latents) // PATCH**2
        shape = config.layers, batch, tokens, config.heads, config.head_dim
        keys, values = (constrain(jnp.zeros(shape, config.attention_dtype), CACHE) for _ in "kv")
        return KeyValueCache(keys=keys, values=values, latents=latents)

    def denoise_chunk(
        self,
        noisy: Float[Array, "b f h w c"],
        t: Float[Array, " b"],
        context: DiTContext,
        cache: KeyValueCache,
    ) -> tuple[Float[Array, "b f h w c"], KeysValues]:
        """Return the velocity of the next chunk of a clip, and the chunk's keys and values.

        The cache has the keys and values of the chunks before it.
        """
        cache.check(noisy.shape, context.first_frame)
        start = context.first_frame * context.patches.shape[1] // noisy.shape[1]
        x, kept = self._through(
            self.patch.noisy(noisy) + context.patches,
            t[:, None],
            context,
            lambda past: cached(past, start, self.config.attention),
            past=(cache.keys, cache.values) if start else None,
        )
        return _unpatched(x, noisy.shape), kept

    def _through(
        self,
        x: Float[Array, "b n d"],
        t: Float[Array, "b g"],
        context: DiTContext,
        attention: Callable[[KeysValues | None], Attend],
        *,
        lengths: Sequence[int] = (0,),
        past: KeysValues | None = None,
    ) -> tuple[Float[Array, "b n o"], Any]:
        """Pass tokens through blocks and head; also return what `attention` keeps of the layers.

        `t` are the timesteps of runs of tokens of these lengths.
        """
        time, modulation = (by_run(vectors, lengths) for vectors in self.time(t))
        time, modulation = constrain(time, VECTORS), constrain(modulation, (*VECTORS, None))

        def step(block: Block, x: jax.Array, given: tuple) -> tuple:
            sources, past = given
            x = remat.name_input(x)
            x, kept = block(x, modulation, context.rotation, sources, attention(past))
            return constrain(x, TOKENS), kept

        x, kept = scan_blocks(
            step,
            self.blocks,
            constrain(x, TOKENS),
            (context.sources, past),
            remat=remat.wrapper(self.config.remat),
        )
        return self.head(x, time), kept

    def __call__(
        self,
        latents: Float[Array, "b f h w c"],
        t: Float[Array, " b"],
        text: Float[Array, "b n e"],
        image: Float[Array, "b m i"] | None = None,
    ) -> Float[Array, "b f h w v"]:
        """Return the velocity for noisy latents and condition in one array."""
        noisy, condition = jnp.split(latents, [self.config.out_channels], axis=-1)
        return self.denoise(noisy, t, self.prepare(condition, text, image))

    def _check_image(self, *, has_image: bool) -> None:
        config = self.config
        if has_image != (config.image_dim is not None):
            given, fix = ("were", "Omit them") if has_image else ("were not", "Pass them")
            raise InputError(
                f"Image tokens {given} given to a model with image_dim {config.image_dim}. {fix}."
            )


def _unpatched(x: Float[Array, "b n o"], shape: tuple[int, ...]) -> Float[Array, "b f h w c"]:
    """Return the velocity's patches as latents of this shape."""
    _, _, h, w, _ = shape
    return rearrange(
        x,
        "b (f h w) (i j c) -> b f (h i) (w j) c",
        h=h // PATCH,
        w=w // PATCH,
        i=PATCH,
        j=PATCH,
    )
