"""Names of the video transformer's weights: Wan 2.1's official files and diffusers' model.

EgoSim and Wan 2.1 Fun InP have the official names. Like every table: `wan` and `diffusers` give
the rules of a naming, `ignored` the patterns of names, in any naming, that the network does not
use.
"""

from __future__ import annotations

from egosim_jax.convert.rules import Rule
from egosim_jax.models.wan.config import WanDiTConfig

PATCH_KERNEL = "o c 1 i j -> c i j o"
MODULATION = "1 k d -> k d"


def wan(config: WanDiTConfig) -> list[Rule]:
    """Rules for the official state dict, for any input width."""
    rules = [
        Rule("patch_embedding.weight", "patch.kernel", PATCH_KERNEL),
        Rule("patch_embedding.bias", "patch.bias"),
        *_linear("text_embedding.0", "text.up"),
        *_linear("text_embedding.2", "text.down"),
        *_linear("time_embedding.0", "time.mlp.up"),
        *_linear("time_embedding.2", "time.mlp.down"),
        *_linear("time_projection.1", "time.modulation"),
        Rule("blocks.*.modulation", "blocks.modulation", MODULATION),
        *_norm("blocks.*.norm3", "blocks.cross_norm"),
        *_linear("blocks.*.ffn.0", "blocks.mlp.up"),
        *_linear("blocks.*.ffn.2", "blocks.mlp.down"),
        Rule("head.modulation", "head.modulation", MODULATION),
        *_linear("head.head", "head.linear"),
    ]
    for attention in ("self_attn", "cross_attn"):
        theirs, ours = f"blocks.*.{attention}", f"blocks.{attention}"
        for name in "qkvo":
            rules += _linear(f"{theirs}.{name}", f"{ours}.{name}")
        for name in ("norm_q", "norm_k"):
            rules.append(Rule(f"{theirs}.{name}.weight", f"{ours}.{name}.scale"))
    if config.image_dim is not None:
        theirs, ours = "blocks.*.cross_attn", "blocks.cross_attn.image"
        rules += [
            *_norm("img_emb.proj.0", "image.norm_in"),
            *_linear("img_emb.proj.1", "image.mlp.up"),
            *_linear("img_emb.proj.3", "image.mlp.down"),
            *_norm("img_emb.proj.4", "image.norm_out"),
            *_linear(f"{theirs}.k_img", f"{ours}.k"),
            *_linear(f"{theirs}.v_img", f"{ours}.v"),
            Rule(f"{theirs}.norm_k_img.weight", f"{ours}.norm_k.scale"),
        ]
    return rules


def diffusers(config: WanDiTConfig) -> list[Rule]:
    """Rules for the state dict of diffusers' `WanTransformer3DModel`."""
    embedder = "condition_embedder"
    rules = [
        Rule("patch_embedding.weight", "patch.kernel", PATCH_KERNEL),
        Rule("patch_embedding.bias", "patch.bias"),
        *_linear(f"{embedder}.text_embedder.linear_1", "text.up"),
        *_linear(f"{embedder}.text_embedder.linear_2", "text.down"),
        *_linear(f"{embedder}.time_embedder.linear_1", "time.mlp.up"),
        *_linear(f"{embedder}.time_embedder.linear_2", "time.mlp.down"),
        *_linear(f"{embedder}.time_proj", "time.modulation"),
        Rule("blocks.*.scale_shift_table", "blocks.modulation", MODULATION),
        *_norm("blocks.*.norm2", "blocks.cross_norm"),
        *_linear("blocks.*.ffn.net.0.proj", "blocks.mlp.up"),
        *_linear("blocks.*.ffn.net.2", "blocks.mlp.down"),
        Rule("scale_shift_table", "head.modulation", MODULATION),
        *_linear("proj_out", "head.linear"),
    ]
    for theirs, ours in (
        ("blocks.*.attn1", "blocks.self_attn"),
        ("blocks.*.attn2", "blocks.cross_attn"),
    ):
        for name in "qkv":
            rules += _linear(f"{theirs}.to_{name}", f"{ours}.{name}")
        rules += _linear(f"{theirs}.to_out.0", f"{ours}.o")
        for name in ("norm_q", "norm_k"):
            rules.append(Rule(f"{theirs}.{name}.weight", f"{ours}.{name}.scale"))
    if config.image_dim is not None:
        theirs, ours = "blocks.*.attn2", "blocks.cross_attn.image"
        rules += [
            *_norm(f"{embedder}.image_embedder.norm1", "image.norm_in"),
            *_linear(f"{embedder}.image_embedder.ff.net.0.proj", "image.mlp.up"),
            *_linear(f"{embedder}.image_embedder.ff.net.2", "image.mlp.down"),
            *_norm(f"{embedder}.image_embedder.norm2", "image.norm_out"),
            *_linear(f"{theirs}.add_k_proj", f"{ours}.k"),
            *_linear(f"{theirs}.add_v_proj", f"{ours}.v"),
            Rule(f"{theirs}.norm_added_k.weight", f"{ours}.norm_k.scale"),
        ]
    return rules


def ignored(config: WanDiTConfig) -> list[str]:
    """Nothing: the network uses every weight of these files."""
    return []


def _linear(theirs: str, ours: str) -> list[Rule]:
    return [
        Rule(f"{theirs}.weight", f"{ours}.kernel", "linear"),
        Rule(f"{theirs}.bias", f"{ours}.bias"),
    ]


def _norm(theirs: str, ours: str) -> list[Rule]:
    return [Rule(f"{theirs}.weight", f"{ours}.scale"), Rule(f"{theirs}.bias", f"{ours}.bias")]
