"""Causal student of `tabletop`: it makes a clip in three chunks, of 1, 8 and 8 frames.

Its weights are a LoRA of the denoiser of `tabletop`, in the same folder.
"""

from dataclasses import replace

from egosim_jax.configs.tabletop import CONFIG as TABLETOP
from egosim_jax.models.chunks import Chunks

CONFIG = replace(TABLETOP, name="tabletop_student", chunks=Chunks(sizes=(1, 2, 2)))
SHIPPED_WITH = "tabletop"
"""Config whose folder has the weights."""
TRAINING = (
    "egosim train tabletop_student_dmd --weights egosim_jax/weights/tabletop "
    "--latents runs/tabletop/latents/train --out runs/student"
)
"""Command that trains the weights."""
