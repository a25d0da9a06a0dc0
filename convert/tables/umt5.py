"""Conversion table of the umT5 text encoder: Wan's official file and transformers' model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from egosim_jax.convert.rules import Rule
from egosim_jax.convert.tables import (
    SHORT_VOCAB,
    Comparison,
    Naming,
    Reference,
    Table,
    fewer_layers,
)
from egosim_jax.models.t5 import T5Sizes, UMT5Config
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.io.mapped import Tensor

Sizes = TypeVar("Sizes", bound=T5Sizes)
TOKENS = 128
"""Length of the prompt in a reference forward."""


def wan(config: UMT5Config) -> list[Rule]:
    """Return the rules for `models_t5_umt5-xxl-enc-bf16.pth`, the same for any size."""
    return [
        Rule("token_embedding.weight", "embed.embedding"),
        Rule("blocks.*.norm1.weight", "blocks.norm1.scale"),
        *_linears("blocks.*.attn", "blocks.attn", {name: name for name in "qkvo"}),
        Rule("blocks.*.pos_embedding.embedding.weight", "blocks.attn.position_bias"),
        Rule("blocks.*.norm2.weight", "blocks.norm2.scale"),
        *_linears("blocks.*.ffn", "blocks.ffn", {"gate.0": "gate", "fc1": "up", "fc2": "down"}),
        Rule("norm.weight", "norm.scale"),
    ]


def transformers(config: T5Sizes) -> list[Rule]:
    """Return the rules for transformers' `UMT5EncoderModel`, the same for any size."""
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


def check(tensors: Mapping[str, Tensor]) -> None:
    """Raise `InputError` for T5, which has a position bias in its first block alone."""
    second = "encoder.block.1.layer.0.SelfAttention"
    bias = f"{second}.relative_attention_bias.weight"
    if f"{second}.q.weight" in tensors and bias not in tensors:
        raise InputError("The text encoder is T5, not umT5. (--config)")


def ignored(config: T5Sizes) -> list[str]:
    """Return the duplicate of the token table, which the rules read as `shared.weight`."""
    return ["encoder.embed_tokens.weight"]


def arguments(config: T5Sizes) -> dict[str, Any]:
    """Return the arguments of transformers' `UMT5Config`."""
    return {
        "vocab_size": config.vocab,
        "d_model": config.dim,
        "d_kv": config.head_dim,
        "d_ff": config.ffn_dim,
        "num_layers": config.layers,
        "num_heads": config.heads,
        "relative_attention_num_buckets": config.buckets,
        "relative_attention_max_distance": config.max_distance,
        "layer_norm_epsilon": config.eps,
        "feed_forward_proj": "gated-gelu",
    }


def shorten(config: Sizes) -> Sizes:
    """Return a float32 config with fewer layers and a shorter token table."""
    return replace(fewer_layers(config), vocab=min(SHORT_VOCAB, config.vocab))


def outputs(comparison: Comparison) -> tuple[np.ndarray, np.ndarray]:
    """Return both embeddings of random tokens."""
    import torch

    config = comparison.config
    ids = np.random.default_rng(0).integers(0, config.vocab, (1, TOKENS), np.int32)
    mask = np.ones(ids.shape, bool)
    have = comparison.output(ids, mask)
    with torch.no_grad():
        module = comparison.load(comparison.make(config))
        want = module(torch.from_numpy(ids).long(), torch.from_numpy(mask).long())
    return have, want.last_hidden_state.numpy()


def _linears(source: str, target: str, names: dict[str, str]) -> list[Rule]:
    return [
        Rule(f"{source}.{theirs}.weight", f"{target}.{ours}.kernel", "linear")
        for theirs, ours in names.items()
    ]


REFERENCE = Reference(
    library="transformers",
    kind="UMT5EncoderModel",
    arguments=arguments,
    shorten=shorten,
    outputs=outputs,
    model_type="umt5",
)
TABLE = Table(
    namings={
        "wan": Naming(
            rules=wan,
            signature="blocks.0.ffn.gate.0.weight",
            layout="wan",
            stem="models_t5_umt5-xxl-enc-bf16",
        ),
        "transformers": Naming(
            rules=transformers,
            signature="encoder.block.0.layer.0.SelfAttention.q.weight",
            layout="diffusers",
            folder="text_encoder",
            stem="model",
        ),
    },
    ignored=ignored,
    check=check,
    reference=REFERENCE,
)
