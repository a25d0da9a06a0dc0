"""Names of the umT5 encoder's weights: Wan's official file and transformers' `UMT5EncoderModel`.

Like every table: `wan` and `transformers` give the rules of a naming, `ignored` the patterns of
names, in any naming, that the network does not use.
"""

from __future__ import annotations

from egosim_jax.convert.rules import Rule
from egosim_jax.models.wan.umt5 import UMT5Config


def wan(config: UMT5Config) -> list[Rule]:
    """Rules for `models_t5_umt5-xxl-enc-bf16.pth`, the same for any size."""
    return [
        Rule("token_embedding.weight", "embed.embedding"),
        Rule("blocks.*.norm1.weight", "blocks.norm1.scale"),
        *_linears("blocks.*.attn", "blocks.attn", {name: name for name in "qkvo"}),
        Rule("blocks.*.pos_embedding.embedding.weight", "blocks.attn.position_bias"),
        Rule("blocks.*.norm2.weight", "blocks.norm2.scale"),
        *_linears("blocks.*.ffn", "blocks.ffn", {"gate.0": "gate", "fc1": "up", "fc2": "down"}),
        Rule("norm.weight", "norm.scale"),
    ]


def transformers(config: UMT5Config) -> list[Rule]:
    """Rules for the state dict of transformers' `UMT5EncoderModel`, the same for any size."""
    attention = "encoder.block.*.layer.0.SelfAttention"
    ffn = "encoder.block.*.layer.1.DenseReluDense"
    return [
        Rule("shared.weight", "embed.embedding"),
        Rule("encoder.block.*.layer.0.layer_norm.weight", "blocks.norm1.scale"),
        *_linears(attention, "blocks.attn", {name: name for name in "qkvo"}),
        Rule(f"{attention}.relative_attention_bias.weight", "blocks.attn.position_bias"),
        Rule("encoder.block.*.layer.1.layer_norm.weight", "blocks.norm2.scale"),
        *_linears(ffn, "blocks.ffn", {"wi_0": "gate", "wi_1": "up", "wo": "down"}),
        Rule("encoder.final_layer_norm.weight", "norm.scale"),
    ]


def ignored(config: UMT5Config) -> list[str]:
    """The token table under its second name; the rules read it as `shared.weight`."""
    return ["encoder.embed_tokens.weight"]


def _linears(source: str, target: str, names: dict[str, str]) -> list[Rule]:
    return [
        Rule(f"{source}.{theirs}.weight", f"{target}.{ours}.kernel", "linear")
        for theirs, ours in names.items()
    ]
