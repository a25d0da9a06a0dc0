"""From triplets to the conditions of a denoiser: pack them into arrays, then encode the arrays.

    triplets --pack--> Batch --encode_condition--> Condition

Training reads batches of latents shards, in which some arrays are encoded already;
`encode_condition` encodes the rest.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, UInt8, UInt32

from egosim_jax.conditioning.condition import Condition
from egosim_jax.conditioning.pixels import clip_pixels, to_model
from egosim_jax.conditioning.posterior import (
    EncodingNoise,
    NormalizedCodec,
    add_pixel_noise,
    draw,
    posterior,
)
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.sharding import replicate_params
from egosim_jax.types import InputError, Triplet

T = TypeVar("T")
Batch = Mapping[str, Any]
"""Arrays of a batch of clips, by name; arrays that a model does not use are absent.

    prior hands target   uint8 videos `b f h w 3`; encoded: latents `b f h w z`
    mask                 packed mask, uint8 `b f h w m`
    ids ids_mask         tokens of the prompts `b n`; encoded: `text`, `b n d`
    null_ids null_mask   tokens of `ModelConfig.unconditional_prompt`; encoded: `null_text`
    pixels               first frames for CLIP, float32 `b s s 3`; encoded: `image`, `b m e`
    seeds                seeds of the model's `encoding_noise`, uint32 `b`
"""
SOLVER_NOISE, PRIOR_NOISE, HANDS_NOISE = 1, 2, 3
"""Uses of a seed, each with another key; the initial noise uses the seed's key itself."""


def pack(
    triplets: Sequence[Triplet], config: ModelConfig, seeds: Sequence[int] | None = None
) -> dict[str, np.ndarray]:
    """Return triplets as a batch: tokenize prompts, pack masks, resize the images for CLIP.

    `seeds` are needed, and kept, only if the encoding draws noise.
    """
    batch = {**pack_clip(triplets, config), **pack_videos(triplets, config)}
    if seeds is not None and config.encoding_noise is not None:
        batch["seeds"] = last_32_bits(seeds)
    return batch


def pack_clip(triplets: Sequence[Triplet], config: ModelConfig) -> dict[str, np.ndarray]:
    """Return the arrays of a batch that all frames of a clip share: prompts and images."""
    tokens = config.tokenizer.tokenize([t.prompt for t in triplets])
    batch = {"ids": tokens.ids, "ids_mask": tokens.mask}
    if config.unconditional_prompt is not None:
        null = config.tokenizer.tokenize([config.unconditional_prompt] * len(triplets))
        batch |= {"null_ids": null.ids, "null_mask": null.mask}
    if config.image is not None:
        batch["pixels"] = clip_pixels(
            np.stack([t.first_frame for t in triplets]),
            image_size=config.image.image_size,
            image_range=config.image_range,
        )
    if (image := config.given_image(triplets)) is not None:
        batch["image"] = image
    return batch


def pack_videos(
    triplets: Sequence[Triplet], config: ModelConfig, *, continued: bool = False
) -> dict[str, np.ndarray]:
    """Return the arrays of a batch with frames; `continued` ones follow earlier frames of a clip.

    The first frame of a clip has its own latent frame, so continued frames number 4k.
    """
    layout = config.layout
    videos = {
        name: np.stack([getattr(t, name) for t in triplets])
        for name in ("prior", "hands")
        if name in layout
    }
    if "mask" in layout:
        masks = [np.concatenate([t.mask[:continued], t.mask]) for t in triplets]
        packed = [layout.pack_mask(mask, config.grid)[int(continued) :] for mask in masks]
        videos["mask"] = np.stack(packed)
    return videos


def batch_shapes(size: int, config: ModelConfig) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the shapes and dtypes of `pack`'s result, to compile before there is a batch."""
    shapes = {**clip_shapes(size, config), **video_shapes(size, config)}
    if config.encoding_noise is not None:
        shapes["seeds"] = jax.ShapeDtypeStruct((size,), np.uint32)
    return shapes


def clip_shapes(size: int, config: ModelConfig) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the shapes and dtypes of `pack_clip`'s result."""
    tokens = (config.tokenizer.max_tokens,)
    shapes: dict[str, tuple[tuple[int, ...], Any]] = {
        "ids": (tokens, np.int32),
        "ids_mask": (tokens, np.bool_),
    }
    if config.unconditional_prompt is not None:
        shapes |= {"null_ids": (tokens, np.int32), "null_mask": (tokens, np.bool_)}
    if config.image is not None:
        shapes["pixels"] = (config.image.image_size, config.image.image_size, 3), np.float32
    if (zeros := config.zero_image(1)) is not None:
        shapes["image"] = zeros.shape[1:], zeros.dtype
    return {name: jax.ShapeDtypeStruct((size, *s), dtype) for name, (s, dtype) in shapes.items()}


def video_shapes(
    size: int, config: ModelConfig, chunk: int | None = None
) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the shapes and dtypes of `pack_videos`' result, for a clip or a chunk by index."""
    video, layout = config.video, config.layout
    frames, (latents, *cells) = video.frames, config.latent_shape
    if chunk is not None and config.chunks is not None:
        frames, latents = config.chunk_frames[chunk], config.chunks.sizes[chunk]
    shape = (size, frames, video.height, video.width, 3)
    shapes = {
        name: jax.ShapeDtypeStruct(shape, np.uint8) for name in ("prior", "hands") if name in layout
    }
    if "mask" in layout:
        mask = (size, latents, *cells, layout.count("mask"))
        shapes["mask"] = jax.ShapeDtypeStruct(mask, np.uint8)
    return shapes


def encode_condition(
    networks: Networks, batch: Batch, noise: EncodingNoise | None = None
) -> Condition:
    """Encode the raw arrays of a batch: videos to latents, prompts and images to embeddings.

    Arrays without a network pass through: they are encoded already. `noise` uses the batch's seeds.
    """
    noise = noise or EncodingNoise()
    if "seeds" not in batch and noise != EncodingNoise():
        raise InputError("The encoding draws noise and needs seeds: give each triplet one. (seeds)")
    mask = batch.get("mask")
    return Condition(
        mask=None if mask is None else mask.astype(jnp.float32),
        prior=_latents(networks, batch, "prior", pixel_std=noise.prior_pixels),
        hands=_latents(networks, batch, "hands", drawn=noise.hands),
        text=_embeddings(networks, batch, "text", "ids", "ids_mask"),
        null_text=_embeddings(networks, batch, "null_text", "null_ids", "null_mask"),
        image=batch.get("image")
        if networks.image is None or "pixels" not in batch
        else replicate_params(networks.image)(batch["pixels"]),
    )


def _latents(
    networks: Networks, batch: Batch, name: str, *, pixel_std: float = 0.0, drawn: bool = False
) -> Any:
    """Return the latents of a video: the mean of the VAE's posterior, or a draw from it."""
    if name not in batch or networks.vae is None:
        return batch.get(name)
    pixels = to_model(batch[name])
    if pixel_std:
        pixels = add_pixel_noise(pixels, pixel_std, keys_for(batch["seeds"], PRIOR_NOISE))
    if drawn:
        codec = cast(NormalizedCodec, networks.vae)
        return draw(*posterior(codec, pixels), keys_for(batch["seeds"], HANDS_NOISE))
    return networks.vae.encode(pixels)


def _embeddings(networks: Networks, batch: Batch, name: str, ids: str, mask: str) -> Any:
    """Return the embeddings of prompts: encoded, or the batch's own if there is no encoder."""
    if networks.text is None or ids not in batch:
        return batch.get(name)
    return replicate_params(networks.text)(batch[ids], batch[mask])


def last_32_bits(seeds: Sequence[int]) -> UInt32[np.ndarray, " b"]:
    """Return the last 32 bits of each seed, the part that the noise depends on."""
    return np.array([seed & 0xFFFFFFFF for seed in seeds], np.uint32)


def keys_for(seeds: Array, use: int) -> Key[Array, " b"]:
    """Return a key of each seed for one of its uses, such as `SOLVER_NOISE`."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed), use))(seeds)


def batches(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    """Yield the items in batches of `size`; the last one may be smaller."""
    for first in range(0, len(items), size):
        yield items[first : first + size]


def targets_of(triplets: Sequence[Triplet]) -> UInt8[np.ndarray, "b f h w 3"]:
    """Return the target videos. Raises `InputError` naming the clips without one."""
    without = [t.video_id for t in triplets if t.target is None]
    if without:
        raise InputError(f"{', '.join(without)}: no target to encode. (column video)")
    return np.stack([t.target for t in triplets if t.target is not None])
