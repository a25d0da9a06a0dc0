"""Layers shared by the networks.

Precision: parameters keep the dtype they were given (float32 by default); `Linear` and `Embed`
compute in their `dtype`; norms compute and return float32, and the next `Linear` casts down. With
`products="bfloat16"` a float32 `Linear` rounds the factors of its products, which processors
with instructions for them compute up to twice as fast, and nothing else (`rounded_product`).

Every parameter names its logical axes (`axes=`), which `sharding.py` maps to the mesh:
`embed` the model width, `mlp` the hidden width, `heads` heads x head size, `vocab`, `layers` the
stacked blocks, None an axis that is never sharded.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int

Axes = tuple[str | None, ...]
Initializer = Callable[..., jax.Array]
Block = TypeVar("Block", bound=nnx.Module)
Products = Literal["bfloat16"]
"""Dtype to which the factors of matrix products are rounded, if not the compute dtype."""

lecun_normal = nnx.initializers.lecun_normal()
zeros = nnx.initializers.zeros_init()
ones = nnx.initializers.ones_init()


class LowRankParam(nnx.Param):
    """Weight of a LoRA, so that only those can be trained."""


class LowRank(nnx.Module):
    """Low-rank summand `(x @ down) @ up` of a linear layer's output (`models/lora.py`)."""

    def __init__(self, down: jax.Array, up: jax.Array):
        axes = ("layers",) * (down.ndim - 2)
        self.down = LowRankParam(down, axes=(*axes, None, None))
        self.up = LowRankParam(up, axes=(*axes, None, None))

    def __call__(self, x: Float[Array, "*b i"]) -> Float[Array, "*b o"]:
        """Map the last axis, in x's dtype."""
        return x @ self.down[...].astype(x.dtype) @ self.up[...].astype(x.dtype)


@jax.custom_vjp
def rounded_product(x: Float[Array, "*b i"], kernel: Float[Array, "i o"]) -> Float[Array, "*b o"]:
    """Return `x @ kernel` of factors rounded to bfloat16, with float32 sums.

    In both products of the gradient the factors are rounded, too. Reverse mode only.
    """
    return _round_and_dot(x, kernel, (x.ndim - 1,), (0,))


def _product_forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return rounded_product(x, kernel), (x, kernel)


def _product_backward(saved: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    x, kernel = saved
    rows = tuple(range(x.ndim - 1))
    dx = _round_and_dot(g, kernel, (g.ndim - 1,), (1,))
    return dx.astype(x.dtype), _round_and_dot(x, g, rows, rows).astype(kernel.dtype)


rounded_product.defvjp(_product_forward, _product_backward)


def _round_and_dot(a: Array, b: Array, a_axes: tuple[int, ...], b_axes: tuple[int, ...]) -> Array:
    a, b = a.astype(jnp.bfloat16), b.astype(jnp.bfloat16)
    axes = ((a_axes, b_axes), ((), ()))
    return jax.lax.dot_general(a, b, axes, preferred_element_type=jnp.float32)


class Linear(nnx.Module):
    """Linear layer `x @ kernel + bias`, kernel `[in, out]`, computed in `dtype`."""

    low_rank: LowRank | None
    """Summand of a LoRA; None without."""

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        axes: Axes,
        bias: bool = True,
        dtype: str = "float32",
        products: Products | None = None,
        kernel_init: Initializer = lecun_normal,
        rngs: nnx.Rngs,
    ):
        self.dtype, self.products = jnp.dtype(dtype), products
        self.kernel = nnx.Param(kernel_init(rngs.params(), (in_dim, out_dim)), axes=axes)
        self.bias = nnx.Param(jnp.zeros(out_dim), axes=axes[1:]) if bias else None
        self.low_rank = nnx.data(None)

    def __call__(self, x: Float[Array, "*b i"]) -> Float[Array, "*b o"]:
        """Project the last axis."""
        x, kernel = x.astype(self.dtype), self.kernel[...].astype(self.dtype)
        y = rounded_product(x, kernel) if self.products else x @ kernel
        y = y.astype(self.dtype)
        if self.low_rank is not None:
            y = y + self.low_rank(x)
        return y if self.bias is None else y + self.bias[...].astype(self.dtype)


class Embed(nnx.Module):
    """Table of token embeddings `[vocab, d]`, read in `dtype`."""

    def __init__(self, vocab: int, dim: int, *, dtype: str = "float32", rngs: nnx.Rngs):
        self.dtype = jnp.dtype(dtype)
        table = nnx.initializers.normal(1.0)(rngs.params(), (vocab, dim))
        self.embedding = nnx.Param(table, axes=("vocab", "embed"))

    def __call__(self, ids: Int[Array, "*b"]) -> Float[Array, "*b d"]:
        """Return the embeddings of ids."""
        return self.embedding[...].astype(self.dtype)[ids]


class LayerNorm(nnx.Module):
    """Layer norm over the last axis in float32, with or without a learned scale and bias."""

    def __init__(self, dim: int, *, eps: float, affine: bool = True, axes: Axes = ("embed",)):
        self.eps = eps
        self.scale = nnx.Param(jnp.ones(dim), axes=axes) if affine else None
        self.bias = nnx.Param(jnp.zeros(dim), axes=axes) if affine else None

    def __call__(self, x: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
        """Normalize; the result is float32."""
        x = x.astype(jnp.float32)
        x = x - x.mean(-1, keepdims=True)
        x = x * jax.lax.rsqrt(jnp.square(x).mean(-1, keepdims=True) + self.eps)
        if self.scale is None or self.bias is None:
            return x
        return x * self.scale[...].astype(jnp.float32) + self.bias[...].astype(jnp.float32)


class RMSNorm(nnx.Module):
    """Root-mean-square norm over the last axis in float32, with a learned scale."""

    def __init__(self, dim: int, *, eps: float, axes: Axes = ("embed",)):
        self.eps = eps
        self.scale = nnx.Param(jnp.ones(dim), axes=axes)

    def __call__(self, x: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
        """Normalize; the result is float32."""
        x = x.astype(jnp.float32)
        inverse = jax.lax.rsqrt(jnp.square(x).mean(-1, keepdims=True) + self.eps)
        # Behind the barrier is one number per row. Without it, a GPU's compiler makes the sum and
        # the scaling one kernel, and moves x once more for what follows, such as the rotation.
        return x * jax.lax.optimization_barrier(inverse) * self.scale[...].astype(jnp.float32)


def modulate(
    x: Float[Array, "b n d"], shift: Float[Array, "b _ d"], scale: Float[Array, "b _ d"]
) -> Float[Array, "b n d"]:
    """Scale and shift normalized tokens."""
    return x * (1 + scale) + shift


def init_sharded(make: Callable[..., Any], *args: Any, out_shardings: Any = None) -> Any:
    """Run an initializer as one compiled program, with sharded outputs.

    With its key in `args`, the program is the same for every seed. Alone on a CPU, it runs
    operation by operation: it draws hundreds of arrays once, of few shapes, and to compile all as
    one program takes longer than to train a tiny model.
    """
    if jax.default_backend() == "cpu" and jax.process_count() == 1:
        return jax.device_put(make(*args), out_shardings, may_alias=False)
    return jax.jit(make, out_shardings=out_shardings)(*args)


def stack(make: Callable[[nnx.Rngs], Block], layers: int, *, rngs: nnx.Rngs) -> Block:
    """Build `layers` equal blocks as one module whose parameters have a leading `layers` axis."""
    split = nnx.split_rngs(splits=layers)
    blocks = split(nnx.vmap(make, in_axes=(0,), out_axes=0))(rngs)
    for _, parameter in nnx.to_flat_state(nnx.state(blocks, nnx.Param)):
        parameter.set_metadata(axes=("layers", *parameter.get_metadata()["axes"]))
    return blocks


def scan_blocks(
    step: Callable[[Block, Any, Any], tuple[Any, Any]],
    blocks: Block,
    x: Any,
    per_layer: Any = None,
    *,
    remat: Callable[[Callable], Callable] | None = None,
) -> tuple[Any, Any]:
    """Run `step(block, x, inputs) -> (x, outputs)` over stacked blocks as one scan.

    `x` is a pytree, `per_layer` one with a leading layers axis; the outputs are stacked so too.
    `remat` wraps the scanned body, for instance a `jax.checkpoint` with a policy.
    """
    graph, state = nnx.split(blocks)

    def body(x: Any, inputs: tuple) -> tuple[Any, Any]:
        layer, extra = inputs
        return step(nnx.merge(graph, layer), x, extra)

    return jax.lax.scan(remat(body) if remat else body, x, (state, per_layer))
