"""Conversion table of CogVideoX's VAE: diffusers' names, which follow our module tree."""

from __future__ import annotations

from functools import partial
from typing import Any

from egosim_jax.convert.rules import Rule
from egosim_jax.convert.tables import (
    Naming,
    Reference,
    Table,
    vae_outputs,
    weight_shapes,
)
from egosim_jax.models.cogvideox.vae import CogVideoXVAEConfig

LEAVES = {"kernel": "weight", "bias": "bias", "scale": "weight"}
WORDS = {
    "conv_in": "conv_in.conv",
    "conv_out": "conv_out.conv",
    "conv1": "conv1.conv",
    "conv2": "conv2.conv",
    "shortcut": "conv_shortcut",
    "norm": "norm_layer",
    "scale": "conv_y.conv",
    "shift": "conv_b.conv",
}
"""Names of our layers in diffusers, where they differ."""


def diffusers(config: CogVideoXVAEConfig) -> list[Rule]:
    """Return the rules for the state dict of diffusers' `AutoencoderKLCogVideoX`."""
    return [
        Rule(_name(path, config), path, _layout(path, len(shape)))
        for path, shape in weight_shapes(config).items()
    ]


def arguments(config: CogVideoXVAEConfig) -> dict[str, Any]:
    """Return the arguments of diffusers' `AutoencoderKLCogVideoX`."""
    levels = len(config.dims)
    return {
        "down_block_types": ["CogVideoXDownBlock3D"] * levels,
        "up_block_types": ["CogVideoXUpBlock3D"] * levels,
        "block_out_channels": list(config.dims),
        "latent_channels": config.z_dim,
        "layers_per_block": config.res_blocks,
        "norm_eps": config.eps,
        "norm_num_groups": config.groups,
        "temporal_compression_ratio": config.temporal_stride,
        "scaling_factor": config.scale,
    }


def _name(path: str, config: CogVideoXVAEConfig) -> str:
    """Return diffusers' name of the weight at a path."""
    half, group, *rest = path.split(".")
    *parts, leaf = rest
    if group in ("middle", "levels"):
        index = int(parts.pop(0))
        if group == "middle":
            place = f"mid_block.resnets.{index}"
        else:
            down = half == "encoder"
            blocks = config.res_blocks + (0 if down else 1)
            level, index = divmod(index, blocks + 1)
            stairs, sampler = ("down_blocks", "down") if down else ("up_blocks", "up")
            inner = f"resnets.{index}" if index < blocks else f"{sampler}samplers.0"
            place = f"{stairs}.{level}.{inner}"
    else:
        place = WORDS.get(group, group)
    words = [WORDS.get(part, part) for part in parts]
    return ".".join([half, place, *words, LEAVES[leaf]])


def _layout(path: str, axes: int) -> str:
    """Return the transform of one weight."""
    if axes == 1:
        return "same"
    return {2: "o i 1 1 1 -> i o", 4: "conv2d", 5: "conv3d"}[axes]


TABLE = Table(
    namings={
        "diffusers": Naming(
            rules=diffusers,
            signature="decoder.up_blocks.0.resnets.0.norm1.conv_y.conv.weight",
            layout="diffusers",
            folder="vae",
            stem="diffusion_pytorch_model",
        ),
    },
    reference=Reference(
        library="diffusers",
        kind="AutoencoderKLCogVideoX",
        arguments=arguments,
        outputs=partial(vae_outputs, frames=9),
    ),
)
