"""Causal student of `egosim_1_3b`: chunks of 13, 16, 16 and 16 frames, in 4, 2, 2 and 2 steps."""

from dataclasses import replace

from egosim_jax.configs.egosim_1_3b import CONFIG as EGOSIM_1_3B
from egosim_jax.models.chunks import Chunks

CONFIG = replace(
    EGOSIM_1_3B,
    name="egosim_1_3b_student",
    chunks=Chunks(sizes=(4, 4, 4, 4), first_steps=4),
    steps=2,
)
TRAINING = (
    "egosim train egosim_1_3b_student_dmd --weights runs/student_cd/weights "
    "--teacher weights/egosim_1_3b --latents latents/train --out runs/student"
)
"""Command of the last stage of its training."""
