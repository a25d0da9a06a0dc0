"""EgoSim's conditioning on the 1.3B transformer (Wan 2.1 Fun InP 1.3B widened to 52 channels)."""

import dataclasses

from egosim_jax.configs.egosim_14b import CONFIG as EGOSIM_14B

CONFIG = dataclasses.replace(
    EGOSIM_14B,
    name="egosim_1_3b",
    dit=dataclasses.replace(EGOSIM_14B.dit, dim=1536, ffn_dim=8960, heads=12, layers=30),
)
TRAINING = (
    "egosim train egosim_1_3b --weights weights/base --latents latents --out runs/egosim_1_3b"
)
"""Command that trains the weights."""
