"""DWM's caches of latents: means and log variances of the VAE, one `.pt` tensor per video.

The cache folders are next to the folder of recorded videos. A tensor is [2 z, f, h, w] in bfloat16:
the z means, then the log variances, before the VAE's scaling. A caption's embeddings are [n, d].
The files do not name the VAE that made them, so `check_alike` compares them with new encodings.
"""

from __future__ import annotations

from pathlib import Path

import ml_dtypes
import numpy as np
from einops import rearrange
from jaxtyping import Float32

from egosim_jax.io.bounded import quote_path
from egosim_jax.io.untrusted.pth import read_pth, write_pth
from egosim_jax.types import InputError

FOLDERS = {
    "target": "video_latents",
    "prior": "static_video_latents",
    "hands": "hand_video_latents",
    "text": "prompt_embeds_rewrite",
}
"""Cache folder of each array of a record."""
MAX_ERROR = 0.05
"""Maximum relative RMS error of cached latents; bfloat16 alone rounds by up to 0.004."""
MAX_STD_ERROR = 0.25
"""The same for standard deviations: exp(logvar / 2) amplifies the errors of a network."""


def cache_of(video: Path, array: str) -> Path:
    """Return the cache path of an array, for the clip of a recorded video."""
    return video.parent.parent / FOLDERS[array] / f"{video.stem}.pt"


def read_moments(
    path: Path, shape: tuple[int, int, int, int]
) -> tuple[Float32[np.ndarray, "f h w z"], Float32[np.ndarray, "f h w z"]]:
    """Return means and log variances; raise `InputError` unless they have the shape f h w z."""
    f, h, w, z = shape
    moments = read_tensor(path, (2 * z, f, h, w))
    mean, logvar = rearrange(moments, "(k z) f h w -> k f h w z", k=2)
    return np.ascontiguousarray(mean), np.ascontiguousarray(logvar)


def read_tensor(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Return the one tensor of a `.pt` file in float32; raise `InputError` for other shapes."""
    tensors = [*read_pth(path).values()]
    shapes = [tensor.shape for tensor in tensors]
    if shapes != [shape]:
        raise InputError(
            f"{quote_path(path)} holds {shapes[:3]}: it must be one tensor of {shape}, the latents "
            "of this model at its length and size. They are not resized; encode the videos again."
        )
    values = tensors[0].array().astype(np.float32)
    if not np.isfinite(values).all():
        raise InputError(f"{quote_path(path)} has values that are not finite. Encode them again.")
    return values


def write_moments(
    path: Path, mean: Float32[np.ndarray, "f h w z"], logvar: Float32[np.ndarray, "f h w z"]
) -> None:
    """Write means and log variances in bfloat16."""
    both = rearrange(np.stack([mean, logvar]), "k f h w z -> (k z) f h w")
    write_pth(path, both.astype(ml_dtypes.bfloat16))


def check_alike(
    path: Path, cached: np.ndarray, encoded: np.ndarray, *, limit: float = MAX_ERROR
) -> None:
    """Raise `InputError` if cached values differ from newly encoded ones by more than `limit`."""
    difference = float(np.sqrt(np.square(cached - encoded).mean() / np.square(encoded).mean()))
    if not difference <= limit:
        raise InputError(
            f"{quote_path(path)} was made with other weights: its relative RMS difference from new "
            f"encodings is {difference:.2f}, and the maximum is {limit}. Give the VAE and text "
            "encoder that made the caches, or encode the videos. (--weights)"
        )
