"""DWM's caches of encoded videos: conversion to latents shards, and their own writing.

The first clip of the shards is also encoded from its videos. This checks that the caches are of
the given VAE and text encoder. It also gives the arrays that are the same for all clips, such as
the embeddings of the empty prompt.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np

from egosim_jax.conditioning.pixels import to_model
from egosim_jax.conditioning.posterior import STD
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.data.clip_files import ClipFiles
from egosim_jax.data.clips import load_triplet
from egosim_jax.data.moments import (
    MAX_STD_ERROR,
    cache_of,
    check_alike,
    read_moments,
    read_tensor,
    write_moments,
)
from egosim_jax.data.pack import clip_metadata
from egosim_jax.data.shards import ShardWriter
from egosim_jax.generation.compiled import CompiledFn
from egosim_jax.generation.encoding import pack
from egosim_jax.io.untrusted.pth import write_pth
from egosim_jax.io.weights import hashes
from egosim_jax.train.encode import Encoding, mask_of
from egosim_jax.types import InputError

VIDEOS = ("target", "prior", "hands")


def check_cached(config: ModelConfig) -> None:
    """Raise `InputError` for a model that cannot train on cached moments."""
    if config.posterior != "sampled" or config.encoders == "joint":
        raise InputError(
            f"{config.name} does not train on cached moments: it must draw latents from them and "
            "have frozen encoders, like dwm_cogvideox_5b. Encode the videos. (egosim data encode)"
        )


def shard_caches(
    config: ModelConfig, folder: Path, clips: Sequence[ClipFiles], *, out: Path
) -> Iterator[str]:
    """Write the latents shards of clips from their caches; yield the id of each clip.

    `folder` holds the weights. Raises `InputError` for a model that does not draw latents, and for
    caches of another shape or other weights.
    """
    check_cached(config)
    networks = Networks.load(config, folder, only=config.cached_networks)
    triplet = load_triplet(clips[0], config.video, grid=config.grid)
    (first,) = Encoding(config, networks)([triplet])
    provenance: dict[str, Any] = {
        "config": config.name,
        "encoders": hashes(folder, only=config.cached_networks),
        "source": "caches",
        "mask": mask_of(config),
    }
    with ShardWriter(
        out, kind="latents", spec=config.video, grid=config.grid, provenance=provenance
    ) as writer:
        for number, files in enumerate(clips):
            arrays = _arrays(files, first, networks.vae)
            if number == 0:
                for name in (*VIDEOS, "text"):
                    check_alike(_cache(files, name), arrays[name], first[name])
                for name in VIDEOS:
                    deviations = (given[f"{name}{STD}"] for given in (arrays, first))
                    check_alike(_cache(files, name), *deviations, limit=MAX_STD_ERROR)
            writer.add(arrays, {**clip_metadata(files), "start": 0})
            yield files.video_id


def _arrays(files: ClipFiles, first: Mapping[str, np.ndarray], codec: Any) -> dict[str, np.ndarray]:
    """Return the arrays of a clip from its caches; arrays without a cache are the first clip's."""
    arrays = dict(first)
    for name in VIDEOS:
        mean, logvar = read_moments(_cache(files, name), first[name].shape)
        # Normalization is affine: the deviation is the distance of two normalized points.
        above = mean + np.exp(logvar / 2)
        center, upper = (np.asarray(codec.normalize(jnp.asarray(x))) for x in (mean, above))
        deviation = upper - center
        arrays |= {name: center, f"{name}{STD}": deviation}
    arrays["text"] = read_tensor(_cache(files, "text"), first["text"].shape)
    return {name: array.astype(first[name].dtype) for name, array in arrays.items()}


def _cache(files: ClipFiles, array: str) -> Path:
    if files.target is None:
        raise InputError(f"{files.row}: no recorded video. Its caches must be next to the video.")
    return cache_of(files.target, array)


def write_caches(config: ModelConfig, folder: Path, clips: Sequence[ClipFiles]) -> Iterator[str]:
    """Write the caches of clips next to their recorded videos; yield the id of each clip.

    `folder` holds the weights. Raises `InputError` for a model that does not draw latents, and for
    clips of another length.
    """
    check_cached(config)
    networks = Networks.load(config, folder, only=config.cached_networks)
    encode = CompiledFn(_moments, networks)
    for files in clips:
        triplet = load_triplet(files, config.video, grid=config.grid)
        batch = pack([triplet], config)
        videos = np.stack([getattr(triplet, name)[None] for name in VIDEOS])
        means, logvars, text = encode(videos, batch["ids"], batch["ids_mask"])
        for name, mean, logvar in zip(VIDEOS, means, logvars, strict=True):
            write_moments(_cache(files, name), np.asarray(mean[0]), np.asarray(logvar[0]))
        write_pth(_cache(files, "text"), np.asarray(text[0]).astype(ml_dtypes.bfloat16))
        yield files.video_id


def _moments(encoders: Networks, videos: jax.Array, ids: jax.Array, mask: jax.Array) -> Any:
    """Return means and log variances of the latents of each video, and prompt embeddings."""
    codec: Any = encoders.vae
    means, logvars = jax.lax.map(lambda video: codec.moments(to_model(video)), videos)
    return means, logvars, encoders.text(ids, mask)
