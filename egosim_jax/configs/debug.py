"""Smallest model that has every part, with random weights, to check that everything runs."""

import dataclasses

from egosim_jax.configs.real_tiny import CONFIG as REAL_TINY
from egosim_jax.models.wan.clip_vision import CLIPVisionConfig
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.types import VideoSpec

CONFIG = dataclasses.replace(
    REAL_TINY,
    name="debug",
    video=VideoSpec(frames=9, height=64, width=96, fps=16),
    dit=WanDiTConfig(dim=48, ffn_dim=96, heads=2, layers=2, text_dim=64, image_dim=32),
    vae=dataclasses.replace(REAL_TINY.vae, dim_mult=(1, 1, 2, 2)),
    image=CLIPVisionConfig(image_size=28, dim=32, layers=2, heads=2, ffn_dim=64),
    steps=4,
)
RANDOM_WEIGHTS = True
"""Generate with random weights if none are given."""
TRAINING = "egosim train debug --out runs/debug"
"""Command that trains the weights."""
