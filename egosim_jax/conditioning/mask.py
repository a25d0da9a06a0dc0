"""Packing of the mask of unobserved pixels into channels of the latent grid.

The EgoSim release has these rules. 1 means not observed, generate; 0 means observed, keep. The
Wan 2.1 inpainting models use the opposite. For a mask video of the model's size:

1. A gray level above one half of white is 1, everything else 0.
2. The first frame is all 0: the prior is complete where the video starts.
3. Nearest-neighbor selection down to latent frames and twice the latent rows and columns, by the
   index floor(i in / out). In space this takes every fourth pixel. In time, the release first
   repeats the last frame up to 4f + 1 frames for f latent frames, though a clip has
   4f - 3, and floor(i (4f + 1) / f) = 4i: latent frame i is decided by pixel frame 4i.
4. Each 2 x 2 block of the remaining pixels becomes four channels, channel 2 dh + dw, so that
   latent cell (i, j) holds the pixels (8i + 4dh, 8j + 4dw).

These are the rules of the packing `space` with a codec of strides 4 and 8. `single` and `time` keep
rules 1 and 2 and take one pixel of each latent cell. `single` takes it from the same frame, in one
channel. `time` takes it from every pixel frame that the latent frame encodes, in one channel each
(Wan 2.1). `observed` is 0 everywhere, and raises `InputError` for a mask with holes.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from einops import rearrange
from jaxtyping import Array, Float, UInt8

from egosim_jax.data.static import HALF_WHITE, check_observed
from egosim_jax.types import WAN_GRID, InputError, VideoGrid

Packing = Literal["space", "time", "single", "observed"]


def pack_mask(
    frames: UInt8[np.ndarray, "f h w"],
    *,
    packing: Packing = "space",
    channels: int = 4,
    grid: VideoGrid = WAN_GRID,
) -> UInt8[np.ndarray, "lf lh lw {channels}"]:
    """Return mask channels, 0 or 1, of a gray mask video (255 = not observed).

    Raises `InputError` for a number of frames or a size without latent cells of the grid, and in
    the packing `observed` for pixels that were not observed.
    """
    count, height, width = frames.shape
    time, space = grid.temporal_stride, grid.spatial_stride
    grid.check_frames(count, what="a mask video")
    if height % space or width % space:
        raise InputError(
            f"a mask of {height} x {width} pixels does not divide into latent cells: both must be "
            f"multiples of {space}. Resize it to the model's size first."
        )
    latent_frames = (count - 1) // time + 1
    if packing == "observed":
        check_observed(frames)
        return np.zeros((latent_frames, height // space, width // space, channels), np.uint8)
    if packing == "time":
        # The first latent frame encodes one pixel frame.
        selected = np.maximum(0, np.arange(1 - time, count).reshape(latent_frames, time))
        generate = frames[selected, ::space, ::space] > HALF_WHITE
        generate = rearrange(generate, "f t h w -> f h w t")
    else:
        # Rule 3: the frames that the release repeats are never selected.
        side = 2 if packing == "space" else 1
        generate = frames[::time, :: space // side, :: space // side] > HALF_WHITE
        generate = rearrange(generate, "f (h i) (w j) -> f h w (i j)", i=side, j=side)
    generate[0] = False
    return generate.astype(np.uint8)


def halve_mask(mask: Float[Array, "*b h w m"], packing: Packing) -> Float[Array, "*b i j m"]:
    """Return a packed mask on half the rows and columns: the mask of every second pixel.

    The selection of the nearest pixel keeps it 0 or 1, as the denoiser knows it.
    """
    if packing == "space":
        return rearrange(mask[..., 0], "... (h i) (w j) -> ... h w (i j)", i=2, j=2)
    return mask[..., ::2, ::2, :]
