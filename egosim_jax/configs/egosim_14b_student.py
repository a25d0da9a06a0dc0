"""Causal student of `egosim_14b`: chunks of 13, 16, 16 and 16 frames, in 4, 2, 2 and 2 steps."""

from dataclasses import replace

from egosim_jax.configs.egosim_14b import CONFIG as EGOSIM_14B
from egosim_jax.models.chunks import Chunks

CONFIG = replace(
    EGOSIM_14B,
    name="egosim_14b_student",
    chunks=Chunks(sizes=(4, 4, 4, 4), first_steps=4),
    steps=2,
)
TRAINING = (
    "egosim train egosim_14b_student_dmd --weights runs/student_cd/weights "
    "--teacher weights/egosim_14b --latents latents/train --out runs/student"
)
"""Command of the last stage of its training."""
