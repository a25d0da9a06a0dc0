"""Conversion table of the video VAE: Wan 2.1's official file and diffusers' `AutoencoderKLWan`.

Both follow our module tree: the foreign name is our path with some words replaced.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from egosim_jax.convert.rules import Rule
from egosim_jax.convert.tables import (
    Naming,
    Reader,
    Reference,
    Table,
    vae_outputs,
    weight_shapes,
)
from egosim_jax.models.wan.vae import WanVAEConfig

LEAVES = {"kernel": "weight", "bias": "bias", "scale": "gamma"}
SHARED = {"space": "resample.1", "time": "time_conv", "qkv": "to_qkv", "out": "proj"}
WAN = SHARED | {
    "to_moments": "conv1",
    "from_latents": "conv2",
    "conv_in": "conv1",
    "norm1": "residual.0",
    "conv1": "residual.2",
    "norm2": "residual.3",
    "conv2": "residual.6",
    "norm_out": "head.0",
    "conv_out": "head.2",
}
DIFFUSERS = SHARED | {
    "to_moments": "quant_conv",
    "from_latents": "post_quant_conv",
    "shortcut": "conv_shortcut",
}
RELEASED_RES_BLOCKS = 2
"""Residual blocks per encoder level that diffusers' own renaming supports."""


def wan(config: WanVAEConfig) -> list[Rule]:
    """Return the rules for `Wan2.1_VAE.pth`, without the prefix `model.` of some copies."""

    def place(half: str, group: str, index: int) -> str:
        levels = {"encoder": "downsamples", "decoder": "upsamples"}[half]
        return f"{half}.{levels if group == 'levels' else group}.{index}"

    return _rules(config, WAN, place)


def diffusers(config: WanVAEConfig) -> list[Rule]:
    """Return the rules for the state dict of diffusers' `AutoencoderKLWan`."""

    def place(half: str, group: str, index: int) -> str:
        if group == "middle":
            inner = ("resnets.0", "attentions.0", "resnets.1")[index]
            return f"{half}.mid_block.{inner}"
        if half == "encoder":
            return f"encoder.down_blocks.{index}"
        blocks = config.res_blocks + 1
        level, index = divmod(index, blocks + 1)
        inner = f"resnets.{index}" if index < blocks else "upsamplers.0"
        return f"decoder.up_blocks.{level}.{inner}"

    return _rules(config, DIFFUSERS, place)


def arguments(config: WanVAEConfig) -> dict[str, Any]:
    """Return the arguments of diffusers' `AutoencoderKLWan`."""
    decoder = {} if config.decoder_dim is None else {"decoder_base_dim": config.decoder_dim}
    return {
        "base_dim": config.dim,
        **decoder,
        "z_dim": config.z_dim,
        "dim_mult": list(config.dim_mult),
        "num_res_blocks": config.res_blocks,
        "temperal_downsample": list(config.temporal_downsample),
        "latents_mean": list(config.latent_mean),
        "latents_std": list(config.latent_std),
    }


def to_diffusers(arrays: Mapping[str, Reader], config: WanVAEConfig) -> Mapping[str, Reader] | None:
    """Rename official tensors by diffusers' own table; None for sizes other than the released."""
    from diffusers.loaders import single_file_utils

    if config.res_blocks != RELEASED_RES_BLOCKS:
        return None
    return single_file_utils.convert_wan_vae_to_diffusers(dict(arrays))


def _rules(
    config: WanVAEConfig, words: dict[str, str], place: Callable[[str, str, int], str]
) -> list[Rule]:
    """Return a rule for each weight path, `[half.[group.index.]]part.leaf`."""
    rules = []
    for path, shape in weight_shapes(config).items():
        *where, part, leaf = path.split(".")
        if len(where) == 3:
            half, group, index = where
            where = [place(half, group, int(index))]
        source = ".".join([*where, words.get(part, part), LEAVES[leaf]])
        rules.append(Rule(source, path, _layout(part, leaf, len(shape))))
    return rules


def _layout(part: str, leaf: str, axes: int) -> str:
    """Return the transform of one weight; attention is 2D, everything else 3D."""
    ones = "1 1" if part in ("qkv", "out", "norm") else "1 1 1"
    if leaf == "scale":
        return f"c {ones} -> c"
    if leaf == "bias":
        return "same"
    return {2: f"o i {ones} -> i o", 4: "conv2d", 5: "conv3d"}[axes]


TABLE = Table(
    namings={
        "wan": Naming(
            rules=wan,
            signature="decoder.upsamples.0.residual.2.weight",
            layout="wan",
            stem="Wan2.1_VAE",
            to_reference=to_diffusers,
        ),
        "diffusers": Naming(
            rules=diffusers,
            signature="decoder.up_blocks.0.resnets.0.conv1.weight",
            layout="diffusers",
            folder="vae",
            stem="diffusion_pytorch_model",
        ),
    },
    reference=Reference(
        library="diffusers",
        kind="AutoencoderKLWan",
        arguments=arguments,
        outputs=partial(vae_outputs, frames=5),
    ),
)
