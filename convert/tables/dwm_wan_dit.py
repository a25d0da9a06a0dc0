"""Conversion table of DWM's transformer on Wan: Wan's table, with VideoX-Fun's LoRA names."""

from __future__ import annotations

from dataclasses import replace

from egosim_jax.convert.tables import CheckpointNaming
from egosim_jax.convert.tables.wan_dit import TABLE as WAN

TABLE = replace(
    WAN,
    checkpoint=CheckpointNaming(
        naming="wan",
        stem="lora_diffusion_pytorch_model",
        prefix="lora_unet__",
        separator="_",
        down="lora_down.weight",
        up="lora_up.weight",
        alpha=True,
    ),
)
