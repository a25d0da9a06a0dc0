"""Attention on the H100 and H200: the forward pass of FlashAttention-3 in Pallas.

A block of threads computes 128 queries of a head and walks over its keys and values, BLOCK at a
time. Two warpgroups compute, 64 queries each; the third only fetches. With running maximum t and
sum l of a row, in base 2,

    s  = scale · log2(e) · q kᵀ,   t' = max(t, max s),   p = 2^(s - t')
    l <- 2^(t - t') l + sum p,     o <- 2^(t - t') o + p v,          out = o / l

so the scores are never in memory. The tensor cores get the next block's scores and this block's
p v together; the exponentials of the next block are computed while p v runs
(Shah et al. 2024, "FlashAttention-3", section 3.2).
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import mosaic_gpu as gpu

from egosim_jax.models import flash
from egosim_jax.models.flash import Keys, Queries

ROWS = 64
"""Queries of a warpgroup: the height of Hopper's matrix instructions."""
COMPUTING = 2
"""Number of computing warpgroups; one more loads."""
BLOCK = 128
"""Keys of a block: with more, accumulators do not fit the registers."""
STAGES = 2
"""Blocks of keys and values in shared memory."""
MANY_KEYS = 8 * BLOCK
"""Number of keys from which the kernel is faster than cuDNN, despite filling its pipeline."""
REGISTERS = {"computing": 240, "fetching": 24}
"""Registers of a thread, by the kind of its warpgroup."""


def attend(q: Queries, k: Keys, v: Keys, *, scale: float) -> Queries:
    """Attend in bfloat16 or float16 with float32 sums; by cuDNN if the kernel does not fit."""
    return _attend(q, k, v, scale) if fits(q, k) else flash.cudnn(q, k, v, scale=scale)


def fits(q: jax.Array, k: jax.Array) -> bool:
    """Return whether the kernel supports the numbers of queries and keys, and is faster."""
    _, queries, _, size = q.shape
    keys = k.shape[1]
    whole = queries % (COMPUTING * ROWS) == 0 and keys % BLOCK == 0
    return whole and keys >= MANY_KEYS and size in (64, 128) and q.dtype.itemsize == 2


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _attend(q: Queries, k: Keys, v: Keys, scale: float) -> Queries:
    return hopper_attention(q, k, v, scale)


def _forward(q: Queries, k: Keys, v: Keys, scale: float) -> tuple[jax.Array, Any]:
    return jax.vjp(partial(flash.cudnn, scale=scale), q, k, v)


def _backward(scale: float, pull: Any, g: jax.Array) -> Any:
    return pull(g)


_attend.defvjp(_forward, _backward)


@partial(jax.jit, static_argnums=3)
def hopper_attention(q: Queries, k: Keys, v: Keys, scale: float) -> Queries:
    """Run the kernel, which preflight finds by this name (`preflight/flops.py`)."""
    batch, queries, heads, size = q.shape
    shared = partial(gpu.SMEM, transforms=(gpu.TilingTransform((8, 64)), gpu.SwizzleTransform(128)))
    blocks = shared((STAGES, BLOCK, size), q.dtype)
    return gpu.kernel(
        partial(_tile, steps=k.shape[1] // BLOCK, scale=scale * math.log2(math.e)),
        out_type=jax.ShapeDtypeStruct(q.shape, q.dtype),
        scratch_types={
            "tiles": shared((COMPUTING, ROWS, size), q.dtype),
            "keys": blocks,
            "values": blocks,
            "queries_here": gpu.Barrier(num_barriers=COMPUTING),
            "keys_here": gpu.Barrier(num_barriers=STAGES),
            "values_here": gpu.Barrier(num_barriers=STAGES),
            "keys_done": gpu.Barrier(num_arrivals=COMPUTING, num_barriers=STAGES),
            "values_done": gpu.Barrier(num_arrivals=COMPUTING, num_barriers=STAGES),
        },
        grid=(heads, queries // (COMPUTING * ROWS), batch),
        grid_names=("head", "tile", "sample"),
        num_threads=COMPUTING + 1,
        thread_name="warpgroup",
        kernel_name="hopper_attention",
        compiler_params=gpu.CompilerParams(approx_math=True),
    )(q, k, v)


def _tile(
    q: Any,
    k: Any,
    v: Any,
    out: Any,
    *,
    steps: int,
    scale: float,
    tiles: Any,
    queries_here: Any,
    **memory: Any,
) -> None:
    """Body of a block of threads: each warpgroup runs its part."""
    warpgroup, head, sample = (lax.axis_index(x) for x in ("warpgroup", "head", "sample"))

    @pl.when(warpgroup < COMPUTING)
    def _compute() -> None:
        gpu.set_max_registers(REGISTERS["computing"], action="increase")
        first = (lax.axis_index("tile") * COMPUTING + warpgroup) * ROWS
        rows = (sample, pl.ds(first, ROWS), head)
        tile, here = tiles.at[warpgroup], queries_here.at[warpgroup]
        gpu.copy_gmem_to_smem(q.at[rows], tile, here)
        gpu.barrier_wait(here)
        walk = partial(_walk, tile=tile, steps=steps, scale=scale, **memory)
        tile[...] = pl.run_scoped(walk, gpu.ACC((ROWS, q.shape[-1]), jnp.float32)).astype(q.dtype)
        gpu.commit_smem()
        gpu.copy_smem_to_gmem(tile, out.at[rows])
        gpu.wait_smem_to_gmem(0)

    @pl.when(warpgroup == COMPUTING)
    def _fetch() -> None:
        gpu.set_max_registers(REGISTERS["fetching"], action="decrease")

        def fetch(step: Any, stage: Any, *, wait: bool) -> None:
            block = (sample, pl.ds(step * BLOCK, BLOCK), head)
            for name, source in (("keys", k), ("values", v)):
                if wait:
                    gpu.barrier_wait(memory[f"{name}_done"].at[stage])
                target, here = memory[name].at[stage], memory[f"{name}_here"].at[stage]
                gpu.copy_gmem_to_smem(source.at[block], target, here)

        for stage in range(STAGES):
            fetch(stage, stage, wait=False)
        pl.loop(STAGES, steps)(lambda step: fetch(step, _stage(step), wait=True))


def _walk(
    o: Any,
    *,
    tile: Any,
    steps: int,
    scale: float,
    keys: Any,
    values: Any,
    keys_here: Any,
    values_here: Any,
    keys_done: Any,
    values_done: Any,
) -> jax.Array:
    """Loop of one warpgroup over all keys; `o` accumulates. Return the output in float32."""
    scores = partial(pl.run_scoped, s=gpu.ACC((ROWS, BLOCK), jnp.float32))
    across = lambda x: lax.broadcast_in_dim(x, (ROWS, BLOCK), (0,))  # noqa: E731
    over = lambda x: lax.broadcast_in_dim(x, o.shape, (0,))  # noqa: E731

    def exponentials(s: jax.Array, top: jax.Array) -> tuple[jax.Array, jax.Array]:
        top = jnp.maximum(top, s.max(axis=1) * scale)
        return top, jnp.exp2(s * scale - across(top))

    def first_scores(s: Any) -> jax.Array:
        gpu.wgmma(s, tile, keys.at[0].transpose((1, 0)))
        return s[...]

    gpu.barrier_wait(keys_here.at[0])
    s = scores(first_scores)
    gpu.barrier_arrive(keys_done.at[0])
    lowest = jnp.full((ROWS,), -jnp.inf, jnp.float32)
    top, p = exponentials(s, gpu.layout_cast(lowest, gpu.Layout.WGMMA.reduce(1)))

    def step(j: jax.Array, carry: tuple) -> tuple:
        top, total, p = carry
        stage, before = _stage(j), _stage(j - 1)
        gpu.barrier_wait(keys_here.at[stage])
        gpu.barrier_wait(values_here.at[before])

        def both(s: Any) -> jax.Array:
            gpu.wgmma(s, tile, keys.at[stage].transpose((1, 0)))
            gpu.wgmma(o, p, values.at[before])
            return gpu.wgmma_accumulator_load(s, wait_n=1)  # p v continues

        s = scores(both)
        gpu.barrier_arrive(keys_done.at[stage])
        higher, next_p = exponentials(s, top)
        shrink = jnp.exp2(top - higher)
        total = total * shrink + next_p.sum(axis=1)
        sums = o[...]  # waits for p v
        gpu.barrier_arrive(values_done.at[before])
        o[...] = sums * over(shrink)
        return higher, total, next_p.astype(p.dtype)

    _, total, p = lax.fori_loop(1, steps, step, (top, p.sum(axis=1), p.astype(tile.dtype)))
    last = (steps - 1) % STAGES
    gpu.barrier_wait(values_here.at[last])
    gpu.wgmma(o, p, values.at[last])
    return o[...] * over(1 / total)


def _stage(step: jax.Array) -> jax.Array:
    return lax.rem(step, jnp.int32(STAGES))
