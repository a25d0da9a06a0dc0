"""Conditioning inputs of the denoiser: their order, packing, ranges, tokens and dropout.

Every rule that training and generation must share is here, once. Encoding by networks is not: see
`generation/encoding.py`.

    ChannelLayout        order of the input channels
    Condition            inputs of the denoiser for a batch
    ConditionDropout     classifier-free dropout of the inputs in training
    pack_mask            mask video to channels of the latent grid
    clip_pixels          first frame to the image encoder's input
    to_model, to_uint8   pixels between uint8 and [-1, 1]
"""

from egosim_jax.conditioning.condition import Condition, ConditionDropout
from egosim_jax.conditioning.layout import ChannelLayout
from egosim_jax.conditioning.mask import pack_mask
from egosim_jax.conditioning.pixels import clip_pixels, to_model, to_uint8

__all__ = [
    "ChannelLayout",
    "Condition",
    "ConditionDropout",
    "clip_pixels",
    "pack_mask",
    "to_model",
    "to_uint8",
]
