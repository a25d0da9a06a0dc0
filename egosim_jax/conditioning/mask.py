"""The mask of what must be generated: from gray pixels to four latent channels.

The rules are those of the EgoSim release; 1 says not observed, generate, and 0 observed, keep, the
opposite of the Wan 2.1 inpainting models. For a mask video of the model's size:

1. A gray level above one half of white is 1, everything else 0.
2. The first frame is all 0: the prior is complete where the video starts.
3. Nearest-neighbor selection down to latent frames and twice the latent rows and columns, by the
   index floor(i in / out). In space this takes every fourth pixel. In time, the release first
   repeats the last frame up to 4f + 1 frames for f latent frames, though a clip has
   4f - 3, and floor(i (4f + 1) / f) = 4i: latent frame i is decided by pixel frame 4i.
4. Each 2 x 2 block of what is left becomes four channels, channel 2 dh + dw, so that latent cell
   (i, j) holds the pixels (8i + 4dh, 8j + 4dw).

The release's continuous runner omits the padding of rule 3, so that its 61 frames are selected as
floor(61 i / 16) = 0, 3, 7, 11, 15, 19, ...; `padding="none"` reproduces it.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from einops import rearrange
from jaxtyping import UInt8

from egosim_jax.types import SPATIAL_STRIDE, TEMPORAL_STRIDE, InputError, check_frame_count

HALF_WHITE = 127
"""The last gray level that is not above one half of 255."""


def pack_mask(
    frames: UInt8[np.ndarray, "f h w"], *, padding: Literal["to-4f+1", "none"] = "to-4f+1"
) -> UInt8[np.ndarray, "lf lh lw 4"]:
    """Mask channels, 0 or 1, of a gray mask video (255 = not observed) of 4k+1 frames."""
    count, height, width = frames.shape
    check_frame_count(count, what="a mask video")
    if height % SPATIAL_STRIDE or width % SPATIAL_STRIDE:
        raise InputError(
            f"a mask of {height} x {width} pixels has no whole latent cells: both must be "
            f"multiples of {SPATIAL_STRIDE}. Resize it to the model's size first."
        )
    latent_frames = (count - 1) // TEMPORAL_STRIDE + 1
    source_frames = count if padding == "none" else TEMPORAL_STRIDE * latent_frames + 1
    # The repeated frames themselves are never selected: 4 (f - 1) is the clip's last frame.
    selected = np.arange(latent_frames) * source_frames // latent_frames
    stride = SPATIAL_STRIDE // 2
    generate = (frames[selected, ::stride, ::stride] > HALF_WHITE).astype(np.uint8)
    generate[0] = 0
    return rearrange(generate, "f (h dh) (w dw) -> f h w (dh dw)", dh=2, dw=2)
