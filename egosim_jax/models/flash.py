"""Attention by the vendors' flash kernels: cuDNN on NVIDIA GPUs, splash on TPUs.

Neither stores the scores, forward or backward. Both need lengths that the video's tokens and the
image's 257 tokens do not have, so inputs are padded. Padding is masked by lengths or by segments: a
dense mask would be as large as the scores.
"""

from __future__ import annotations

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from einops import rearrange
from jaxtyping import Array, Float, Int

KEYS = 8
"""cuDNN's backward pass refuses an odd number of keys: they are made a multiple of this."""
LANES = 128
"""Every length of the splash kernel is a multiple of this."""
BLOCKS = tuple(range(1024, 2 * LANES, -LANES))
"""Lengths of a block of the splash kernel for many tokens."""

Queries = Float[Array, "b n h k"]
Keys = Float[Array, "b m h k"]


def cudnn(
    q: Queries,
    k: Keys,
    v: Keys,
    *,
    scale: float,
    implementation: Literal["cudnn", "xla"] = "cudnn",
) -> Queries:
    """Attend by cuDNN (bfloat16 or float16); `xla` computes the same, padding and all, anywhere."""
    keys = k.shape[1]
    lengths = None
    if keys % 2:
        k, v = (_padded(x, -(-keys // KEYS) * KEYS) for x in (k, v))
        lengths = jnp.full(len(k), keys, jnp.int32)
    return jax.nn.dot_product_attention(
        q, k, v, scale=scale, key_value_seq_lengths=lengths, implementation=implementation
    )


def splash(
    q: Queries, k: Keys, v: Keys, *, scale: float, name: str | None, interpret: bool
) -> Queries:
    """Attend by the splash kernel.

    `name` names the residuals of the backward pass for checkpoint policies; `interpret` runs the
    kernel anywhere, slowly.
    """
    from jax.experimental.pallas.ops.tpu.splash_attention import splash_attention_kernel as kernel
    from jax.experimental.pallas.ops.tpu.splash_attention import splash_attention_mask as masks

    (queries, block_q), (keys, block_kv) = _blocks(q.shape[1]), _blocks(k.shape[1])
    ids = None
    if queries != q.shape[1] or keys != k.shape[1]:
        ids = kernel.SegmentIds(q=_outside(queries, q.shape[1]), kv=_outside(keys, k.shape[1]))
    heads = q.shape[2]
    attend = kernel.make_splash_mha(
        masks.MultiHeadMask([masks.FullMask((queries, keys))] * heads),
        block_sizes=kernel.BlockSizes(
            block_q=block_q,
            block_kv=block_kv,
            block_q_dkv=block_q,
            block_kv_dkv=block_kv,
            use_fused_bwd_kernel=True,
        ),
        head_shards=1,
        q_seq_shards=1,
        residual_checkpoint_name=name,
        interpret=interpret,
    )
    scaled = (q.astype(jnp.float32) * scale).astype(q.dtype)
    padded = (_padded(x, length) for x, length in ((scaled, queries), (k, keys), (v, keys)))
    by_head = (rearrange(x, "b n h k -> b h n k") for x in padded)
    out: jax.Array = jax.vmap(partial(attend, segment_ids=ids))(*by_head)  # pyright: ignore[reportAssignmentType]
    return rearrange(out[:, :, : q.shape[1]], "b h n k -> b n h k")


def _blocks(tokens: int) -> tuple[int, int]:
    """Return the shortest padded length and the longest block that divides it."""
    if tokens <= BLOCKS[0]:
        length = -(-tokens // LANES) * LANES
        return length, length
    lengths = {block: -(-tokens // block) * block for block in BLOCKS}
    block = min(lengths, key=lambda block: (lengths[block], -block))
    return lengths[block], block


def _outside(length: int, tokens: int) -> Int[Array, " length"]:
    """Return the segment of each position: 0 for tokens, 1 for padding."""
    return (jnp.arange(length) >= tokens).astype(jnp.int32)


def _padded(x: Float[Array, "b n h k"], length: int) -> Float[Array, "b m h k"]:
    return jnp.pad(x, ((0, 0), (0, length - x.shape[1]), (0, 0), (0, 0)))
