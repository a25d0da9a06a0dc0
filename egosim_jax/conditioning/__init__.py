"""From rendered scene, hands, first frame and text to what the denoiser is told.

One rule, one place: `mask` packs the mask, `video` and `image` set the ranges of pixels, `text`
embeds the prompt, `assemble` orders the 52 channels, `dropout` hides conditions in training.
"""

import jax

from egosim_jax.conditioning.assemble import assemble, condition_channels
from egosim_jax.conditioning.dropout import ConditionDropout
from egosim_jax.conditioning.image import clip_pixels
from egosim_jax.conditioning.mask import pack_mask
from egosim_jax.conditioning.video import to_model, to_uint8
from egosim_jax.types import Condition

__all__ = [
    "ConditionDropout",
    "assemble",
    "clip_pixels",
    "condition_channels",
    "pack_mask",
    "to_model",
    "to_uint8",
]

# `types` knows no jax; whoever builds a Condition comes through here.
jax.tree_util.register_dataclass(Condition)
