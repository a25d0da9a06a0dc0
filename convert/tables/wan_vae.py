"""Names of the video VAE's weights: Wan 2.1's official file and diffusers' `AutoencoderKLWan`.

Both follow our module tree, so that a rule is our path with its words replaced. Like every table:
`wan` and `diffusers` give the rules of a naming, `ignored` the patterns of names, in any naming,
that the network does not use.
"""

from __future__ import annotations

from collections.abc import Callable

from egosim_jax.convert.rules import Rule
from egosim_jax.convert.skeleton import shapes
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


def wan(config: WanVAEConfig) -> list[Rule]:
    """Rules for `Wan2.1_VAE.pth`, without the prefix `model.` that some copies of it have."""

    def place(half: str, group: str, index: int) -> str:
        levels = {"encoder": "downsamples", "decoder": "upsamples"}[half]
        return f"{half}.{levels if group == 'levels' else group}.{index}"

    return _rules(config, WAN, place)


def diffusers(config: WanVAEConfig) -> list[Rule]:
    """Rules for the state dict of diffusers' `AutoencoderKLWan`."""

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


def ignored(config: WanVAEConfig) -> list[str]:
    """Nothing: the network uses every weight of these files."""
    return []


def _rules(
    config: WanVAEConfig, words: dict[str, str], place: Callable[[str, str, int], str]
) -> list[Rule]:
    """A rule for each of our paths, `[half.[group.index.]]part.leaf`."""
    rules = []
    for path, shape in shapes("vae", config).items():
        *where, part, leaf = path.split(".")
        if len(where) == 3:
            half, group, index = where
            where = [place(half, group, int(index))]
        source = ".".join([*where, words.get(part, part), LEAVES[leaf]])
        rules.append(Rule(source, path, _layout(part, leaf, len(shape))))
    return rules


def _layout(part: str, leaf: str, axes: int) -> str:
    """The transform of one weight; attention is written for images, all else for videos."""
    ones = "1 1" if part in ("qkv", "out", "norm") else "1 1 1"
    if leaf == "scale":
        return f"c {ones} -> c"
    if leaf == "bias":
        return "same"
    return {2: f"o i {ones} -> i o", 4: "conv2d", 5: "conv3d"}[axes]
