"""From rendered scene, hands, first frame and text to the conditioning inputs of the denoiser.

One rule, one place: `layout` orders the input channels, `mask` packs the mask, `video` and `image`
set the ranges of pixels, `text` tokenizes prompts, `condition` holds the inputs, `dropout` hides
them in training.
"""

from egosim_jax.conditioning.condition import Condition
from egosim_jax.conditioning.dropout import ConditionDropout
from egosim_jax.conditioning.image import clip_pixels
from egosim_jax.conditioning.layout import ChannelLayout
from egosim_jax.conditioning.mask import pack_mask
from egosim_jax.conditioning.video import to_model, to_uint8

__all__ = [
    "ChannelLayout",
    "Condition",
    "ConditionDropout",
    "clip_pixels",
    "pack_mask",
    "to_model",
    "to_uint8",
]
