"""Conversion table of the T5 1.1 text encoder: transformers' names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from egosim_jax.convert.rules import Rule
from egosim_jax.convert.tables import Table, umt5
from egosim_jax.models.t5 import T5Config
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.io.mapped import Tensor


def transformers(config: T5Config) -> list[Rule]:
    """Return the rules for transformers' `T5EncoderModel`, the same for any size."""
    bias = "relative_attention_bias.weight"
    rules = [rule for rule in umt5.transformers(config) if not rule.source.endswith(bias)]
    first = f"encoder.block.0.layer.0.SelfAttention.{bias}"
    return [*rules, Rule(first, "position_bias")]


def check(tensors: Mapping[str, Tensor]) -> None:
    """Raise `InputError` for umT5, which has a position bias in every block."""
    if "encoder.block.1.layer.0.SelfAttention.relative_attention_bias.weight" in tensors:
        raise InputError("The text encoder is umT5, not T5. (--config)")


TABLE = Table(
    namings={
        "transformers": replace(
            umt5.TABLE.namings["transformers"],
            rules=transformers,
            signature="encoder.block.0.layer.0.SelfAttention.relative_attention_bias.weight",
        ),
    },
    ignored=umt5.ignored,
    check=check,
    reference=replace(umt5.REFERENCE, kind="T5EncoderModel", model_type="t5"),
)
