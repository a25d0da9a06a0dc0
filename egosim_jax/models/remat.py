"""Rematerialization of transformer blocks: activations that the backward pass recomputes.

A block names its input (`name_input`) and the outputs of its attention projections
(`name_projection`), and is scanned with the `wrapper` of a level.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import jax
from jax.ad_checkpoint import checkpoint_name

from egosim_jax.models.attention import keep_attention

Level = Literal["none", "products", "projections", "attention", "full", "offload"]
"""Activations that the backward pass recomputes.

None; all but self-attention and products with weights; all but self-attention and attention's
linear layers; all but self-attention; every block; or every block from its input, which waits in
the host's memory.
"""
LEVELS: tuple[Level, ...] = ("offload", "full", "attention", "projections", "products", "none")
"""All levels, by the memory that they take, ascending."""
_PROJECTION, _BLOCK_INPUT = "projection", "block_input"
_keep_products = jax.checkpoint_policies.save_from_both_policies(
    jax.checkpoint_policies.dots_with_no_batch_dims_saveable, keep_attention
)
_keep_projections = jax.checkpoint_policies.save_from_both_policies(
    jax.checkpoint_policies.save_only_these_names(_PROJECTION), keep_attention
)
_offload_inputs = jax.checkpoint_policies.save_and_offload_only_these_names(
    names_which_can_be_saved=[],
    names_which_can_be_offloaded=[_BLOCK_INPUT],
    offload_src="device",
    offload_dst="pinned_host",
)


def name_input(x: jax.Array) -> jax.Array:
    """Name the input of a block for checkpoint policies."""
    return checkpoint_name(x, _BLOCK_INPUT)


def name_projection(x: jax.Array) -> jax.Array:
    """Name an output of an attention projection for checkpoint policies."""
    return checkpoint_name(x, _PROJECTION)


def wrapper(level: Level) -> Callable[[Callable], Callable] | None:
    """Return the wrapper of the scanned body (`scan_blocks`); None without recomputation."""
    checkpoint = partial(jax.checkpoint, prevent_cse=False)
    return {
        "none": None,
        "full": checkpoint,
        "attention": partial(checkpoint, policy=keep_attention),
        "products": partial(checkpoint, policy=_keep_products),
        "projections": partial(checkpoint, policy=_keep_projections),
        "offload": partial(checkpoint, policy=_offload_inputs),
    }[level]
