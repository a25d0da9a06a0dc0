"""Scaled dot-product attention behind one name, with a choice of kernel.

    out = softmax(s) v,    s = scale · q kᵀ

No kernel keeps the scores for the backward pass. From out and the log-sum-exp l of each row
of s, p = exp(s - l) gives, for the cotangent g of out,

    dv = pᵀ g,    ds = p · (g vᵀ - rowsum(g · out)),    dq = scale · ds k,    dk = scale · dsᵀ q
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
from einops import rearrange
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from egosim_jax.models import flash
from egosim_jax.sharding import (
    ACTIVATIONS,
    constrain,
    device_kind,
    parts,
    platform,
    several_devices,
    spec,
)
from egosim_jax.types import InputError

T = TypeVar("T")
Kernel = Literal["auto", "xla", "cudnn", "hopper", "splash"]
"""Attention kernel.

    xla      runs anywhere; computes a few heads at a time to save memory (`SCORES`)
    cudnn    flash kernel of NVIDIA GPUs, for bfloat16 and float16
    hopper   inference kernel of H100 and H200; cuDNN's where it does not apply, as in training
    splash   flash kernel of TPUs; interpreted elsewhere, for tests
    auto     the device's kernel if it applies
"""
SCORES = 2**26
"""Bytes of scores that the `xla` kernel computes at a time, or one head's if these are more.

A small model's heads are computed all at once, which is faster; a long video's, one by one.
"""
SELF_ATTENTION = "self_attention"
"""Checkpoint name of the residuals that a kernel's backward pass needs."""
HOPPER = ("NVIDIA H100", "NVIDIA H200")
"""Prefixes of jax's names of the devices that have the `hopper` kernel."""
CUDNN_FORWARD = "dot_product_attention_fwd_wrapper"
"""Primitive that returns the output and the log-sum-exp of jax's cuDNN kernel."""


def attention(
    q: Float[Array, "b n h k"],
    k: Float[Array, "b m h k"],
    v: Float[Array, "b m h k"],
    *,
    bias: Float[Array, "#b h n m"] | None = None,
    scale: float | None = None,
    kernel: Kernel = "xla",
    over: Literal["heads", "queries"] | None = None,
) -> Float[Array, "b n h k"]:
    """Attend without a mask; scores and softmax are float32 in every kernel.

    `bias` is added to the scores; `scale` defaults to 1/sqrt(k). The flash kernels support no dense
    bias: only the text encoder, which has few tokens, passes one. On a mesh, `over` is the axis
    that the devices along context divide: heads, if there are as many keys as queries, or queries,
    if there are few keys. Each device then runs the kernel by itself.
    """
    if over is not None and several_devices():
        local = partial(attention, scale=scale, kernel=kernel)
        if over == "heads":
            return split_tokens(by_heads(local, q, k, v))
        _check_parts(q.shape, over)
        queries = spec("batch", "tokens", None, None)
        keys = spec("batch", None, None, None)
        shared = jax.shard_map(
            local, in_specs=(queries, keys, keys), out_specs=queries, check_vma=False
        )
        return split_tokens(shared(split_tokens(q), k, v))
    if bias is not None:
        return jax.nn.dot_product_attention(q, k, v, bias=bias, scale=scale, implementation="xla")
    scale = float(q.shape[-1] ** -0.5) if scale is None else scale
    kernel = _best(q) if kernel == "auto" else kernel
    if kernel == "hopper":
        from egosim_jax.models import hopper  # the import takes a third of a second

        return hopper.attend(q, k, v, scale=scale)
    if kernel == "cudnn":
        return flash.cudnn(q, k, v, scale=scale)
    if kernel == "splash":
        name = SELF_ATTENTION if q.size <= k.size else None
        return flash.splash(q, k, v, scale=scale, name=name, interpret=platform() != "tpu")
    heads = (rearrange(x, "b n h k -> h b n k") for x in (q, k, v))
    return rearrange(_by_head(*heads, scale), "h b n k -> b n h k")


def by_heads(
    attend: Callable[..., T],
    q: Float[Array, "b n h k"],
    k: Float[Array, "b n h k"],
    v: Float[Array, "b n h k"],
    *others: Float[Array, "b m h k"],
) -> T:
    """Return `attend(q, k, v, *others)`; each device along context computes a part of the heads.

    The devices exchange the tokens of q, k and v for heads. The other arrays and the results,
    `b m h k`, are split by heads.
    """
    if not several_devices():
        return attend(q, k, v, *others)
    _check_parts(q.shape, "heads")
    heads = spec("batch", None, "heads", None)
    shared = jax.shard_map(attend, in_specs=heads, out_specs=heads, check_vma=False)
    # Without this, the compiler would also split the weights of q, k and v by heads.
    k, v = split_tokens(k), split_tokens(v)
    return shared(split_tokens(q), k, v, *others)


def split_tokens(x: Float[Array, "b n h k"]) -> Float[Array, "b n h k"]:
    """Constrain the devices along context to split the tokens of heads."""
    return constrain(x, ("batch", "tokens", None, None))


def _best(q: jax.Array) -> Kernel:
    """Return the device's kernel if it supports these inputs, else `xla`."""
    size = q.shape[-1]
    if platform() == "gpu" and q.dtype.itemsize == 2 and size % 8 == 0 and size <= 128:
        return "hopper" if device_kind().startswith(HOPPER) else "cudnn"
    return "splash" if platform() == "tpu" and size % flash.LANES == 0 else "xla"


def _check_parts(shape: tuple[int, ...], over: Literal["heads", "queries"]) -> None:
    batch, tokens, heads, _ = shape
    for name, size, axis in (
        ("samples", batch, "batch"),
        ("tokens", tokens, "tokens"),
        *([("heads", heads, "heads")] if over == "heads" else []),
    ):
        if size % parts(axis):
            raise InputError(
                f"{size} {name} do not divide into the mesh's {parts(axis)} parts: the "
                f"{name} must be a multiple of the product of {' and '.join(ACTIVATIONS[axis])}."
            )


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _by_head(q: jax.Array, k: jax.Array, v: jax.Array, scale: float) -> jax.Array:
    return _forward(q, k, v, scale)[0]


def _forward(q: jax.Array, k: jax.Array, v: jax.Array, scale: float) -> tuple[jax.Array, tuple]:
    def head(qkv: tuple) -> tuple[jax.Array, jax.Array]:
        q, k, v = qkv
        s = _scores(q, k, scale)
        top = s.max(-1, keepdims=True)
        p = jnp.exp(s - top)
        total = p.sum(-1, keepdims=True)
        out = _matmul("b n m, b m k -> b n k", p.astype(v.dtype), v) / total
        return out.astype(v.dtype), top + jnp.log(total)

    out, log_total = jax.lax.map(head, (q, k, v), batch_size=_heads_at_once(q, k))
    if q.size <= k.size:
        out, log_total = (checkpoint_name(x, SELF_ATTENTION) for x in (out, log_total))
    return out, (q, k, v, out, log_total)


def _backward(scale: float, residuals: tuple, g: jax.Array) -> tuple:
    def head(inputs: tuple) -> tuple[jax.Array, jax.Array, jax.Array]:
        q, k, v, out, log_total, g = inputs
        p = jnp.exp(_scores(q, k, scale) - log_total)
        delta = (g.astype(jnp.float32) * out.astype(jnp.float32)).sum(-1, keepdims=True)
        ds = (p * (_matmul("b n k, b m k -> b n m", g, v) - delta)).astype(q.dtype)
        dv = _matmul("b n m, b n k -> b m k", p.astype(g.dtype), g)
        dq = _matmul("b n m, b m k -> b n k", ds, k) * scale
        dk = _matmul("b n m, b n k -> b m k", ds, q) * scale
        return dq.astype(q.dtype), dk.astype(k.dtype), dv.astype(v.dtype)

    q, k, *_ = residuals
    return jax.lax.map(head, (*residuals, g), batch_size=_heads_at_once(q, k))


_by_head.defvjp(_forward, _backward)


def _heads_at_once(q: jax.Array, k: jax.Array) -> int:
    heads, batch, queries, _ = q.shape
    fit = SCORES // (4 * batch * queries * k.shape[2])
    return max((n for n in range(1, min(fit, heads) + 1) if heads % n == 0), default=1)


def _scores(q: jax.Array, k: jax.Array, scale: float) -> jax.Array:
    return _matmul("b n k, b m k -> b n m", q, k) * scale


def _matmul(pattern: str, a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.einsum(pattern, a, b, preferred_element_type=jnp.float32)


def keep_attention(primitive: Any, *operands: Any, **parameters: Any) -> bool:
    """Return whether a checkpointed block keeps a value: only the output of self-attention.

    This is a policy of `jax.checkpoint`. The kernels' backward passes need the output and the
    log-sum-exp; keeping both spares a second forward pass of the kernel. Self-attention has at
    least as many keys as queries. Cross-attention, which has few keys, is recomputed.
    """
    if primitive.name == CUDNN_FORWARD:
        return operands[0].size <= operands[1].size
    return primitive.name == "name" and parameters["name"] == SELF_ATTENTION
