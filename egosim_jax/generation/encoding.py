"""From triplets to the conditions of a denoiser: tokenize and pack, then encode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt8, UInt32

from egosim_jax.conditioning.condition import Condition
from egosim_jax.conditioning.image import clip_pixels
from egosim_jax.conditioning.posterior import (
    EncodingNoise,
    NormalizedCodec,
    add_pixel_noise,
    draw,
    posterior,
)
from egosim_jax.conditioning.video import to_model
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.sharding import replicate_params
from egosim_jax.types import InputError, Triplet


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Inputs:
    """Batch of triplets as arrays."""

    prior: UInt8[Any, "b f h w 3"] | None
    hands: UInt8[Any, "b f h w 3"] | None
    mask: UInt8[Any, "b lf lh lw m"] | None
    ids: Int[Any, "b n"]
    ids_mask: Bool[Any, "b n"]
    null_ids: Int[Any, "b n"] | None
    """Token ids of the model's `unconditional_prompt`."""
    null_mask: Bool[Any, "b n"] | None
    pixels: Float[Any, "b s s 3"] | None
    image: Float[Any, "b m e"] | None = None
    """Image tokens of zeros, of a model that has them in place of an encoder's."""
    seeds: UInt32[Any, " b"] | None = None
    """Seeds of the model's `encoding_noise`; None without."""

    @classmethod
    def of(
        cls, triplets: Sequence[Triplet], config: ModelConfig, seeds: Sequence[int] | None = None
    ) -> Inputs:
        """Tokenize the prompts, pack the masks and prepare the image for CLIP.

        `seeds` are only needed, and kept, where the encoding is random.
        """
        tokens, layout = config.tokenizer.tokenize([t.prompt for t in triplets]), config.layout
        masks = [layout.pack_mask(t.mask, config.grid) for t in triplets if "mask" in layout]
        null = config.unconditional_prompt
        nulls = None if null is None else config.tokenizer.tokenize([null] * len(triplets))
        return cls(
            prior=np.stack([t.prior for t in triplets]) if "prior" in layout else None,
            hands=np.stack([t.hands for t in triplets]) if "hands" in layout else None,
            mask=np.stack(masks) if "mask" in layout else None,
            ids=tokens.ids,
            ids_mask=tokens.mask,
            null_ids=nulls and nulls.ids,
            null_mask=nulls and nulls.mask,
            pixels=config.image
            and clip_pixels(
                np.stack([t.first_frame for t in triplets]),
                image_size=config.image.image_size,
                image_range=config.image_range,
            ),
            image=config.given_image(triplets),
            seeds=None if seeds is None or config.encoding_noise is None else last_32_bits(seeds),
        )

    @classmethod
    def shapes(cls, batch: int, config: ModelConfig) -> Inputs:
        """Return the shapes and dtypes of a batch, to compile for before there is one."""
        shape = lambda dtype, *sizes: jax.ShapeDtypeStruct((batch, *sizes), dtype)  # noqa: E731
        video, tokens, layout = config.video, config.tokenizer.max_tokens, config.layout
        frames = shape(np.uint8, video.frames, video.height, video.width, 3)
        size = config.image and config.image.image_size
        mask = shape(np.uint8, *config.latent_shape, layout.count("mask"))
        null, zeros = config.unconditional_prompt is not None, config.zero_image(1)
        return cls(
            prior=frames if "prior" in layout else None,
            hands=frames if "hands" in layout else None,
            mask=mask if "mask" in layout else None,
            ids=shape(np.int32, tokens),
            ids_mask=shape(np.bool_, tokens),
            null_ids=shape(np.int32, tokens) if null else None,
            null_mask=shape(np.bool_, tokens) if null else None,
            pixels=size and shape(np.float32, size, size, 3),
            image=None if zeros is None else shape(zeros.dtype, *zeros.shape[1:]),
            seeds=None if config.encoding_noise is None else shape(np.uint32),
        )


def encode_condition(
    networks: Networks, inputs: Inputs, noise: EncodingNoise | None = None
) -> Condition:
    """Encode the conditions: videos to latents, prompt and image to tokens.

    `noise` draws from the inputs' seeds.
    """
    noise = noise or EncodingNoise()
    if inputs.seeds is None and noise != EncodingNoise():
        raise InputError("A random encoding needs seeds: give each triplet one. (seeds)")
    keys: Any = (
        () if inputs.seeds is None else (keys_for(inputs.seeds, 2), keys_for(inputs.seeds, 3))
    )

    def encode(video: Array | None, *, std: float = 0.0, drawn: bool = False) -> Array | None:
        if video is None:
            return None
        pixels: Any = to_model(video)
        if std:
            pixels = add_pixel_noise(pixels, std, keys[0])
        if drawn:
            return draw(*posterior(cast(NormalizedCodec, networks.vae), pixels), keys[1])
        return networks.vae.encode(pixels)

    embed = replicate_params(networks.text)
    return Condition(
        mask=None if inputs.mask is None else inputs.mask.astype(jnp.float32),
        prior=encode(inputs.prior, std=noise.prior_pixels),
        hands=encode(inputs.hands, drawn=noise.hands),
        text=embed(inputs.ids, inputs.ids_mask),
        null_text=None
        if inputs.null_ids is None or inputs.null_mask is None
        else embed(inputs.null_ids, inputs.null_mask),
        image=inputs.image
        if networks.image is None or inputs.pixels is None
        else replicate_params(networks.image)(inputs.pixels),
    )


def last_32_bits(seeds: Sequence[int]) -> UInt32[np.ndarray, " b"]:
    """Return the part of each seed that counts, its last 32 bits."""
    return np.array([seed & 0xFFFFFFFF for seed in seeds], np.uint32)


def keys_for(seeds: Array, use: int) -> Key[Array, " b"]:
    """Return a key of each seed for one of its uses."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed), use))(seeds)
