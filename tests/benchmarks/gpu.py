"""Random weights and inputs on a device, and what running a program on them takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.generation.generator import Generator
from egosim_jax.preflight.targets import GIB, peak


def draw_generator(config: ModelConfig, line: dict[str, Any]) -> Generator:
    """Return a generator of random weights in bfloat16, drawn on the device."""
    graph, params = nnx.split(Networks.abstract(config))
    networks = nnx.merge(graph, timed(line, "weights_s", lambda: draw(half(params))))
    return Generator(config, networks)


def compile_all(
    generator: Generator, clips: int, line: dict[str, Any], *, streamed: bool = False
) -> Iterator[tuple[str, Any, tuple]]:
    """Compile and yield the programs of a generator."""
    for name, program, given in generator.programs(clips, streamed=streamed):
        timed(line, f"{name}_compile_s", lambda p=program, g=given: p.compile(*g))
        yield name, program, given


def half(params: Any) -> Any:
    """The same shapes, float32 as bfloat16."""
    dtype = lambda leaf: jnp.bfloat16 if leaf.dtype == jnp.float32 else leaf.dtype  # noqa: E731
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, dtype(leaf)), params)


def draw(shapes: Any) -> Any:
    """Random arrays of these shapes; zeros would be multiplied faster.

    Weights have the scale of trained weights, and data have a deviation of 1: on smaller numbers a
    GPU takes less power, and is faster.
    """
    paths, tree = jax.tree.flatten_with_path(shapes)
    drawn = []
    for seed, (path, leaf) in enumerate(paths):
        name = jax.tree_util.keystr(path)
        float8 = leaf.dtype == jnp.float8_e4m3fn
        x = _random(seed, leaf.shape, jnp.bfloat16 if float8 else leaf.dtype)
        if "kernel" in name or "embedding" in name or "bias" in name or "modulation" in name:
            x = x * jnp.asarray(0.02, x.dtype)
        elif "scale" in name:
            x = jnp.ones_like(x)
        drawn.append(x.astype(leaf.dtype))
    return jax.tree.unflatten(tree, drawn)


@partial(jax.jit, static_argnums=(1, 2))
def _random(seed: int, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    key = jax.random.key(seed, impl="rbg")
    if jnp.issubdtype(dtype, jnp.floating):
        return jax.random.normal(key, shape, dtype)
    if dtype == jnp.bool_:
        return jnp.ones(shape, dtype)
    return jax.random.randint(key, shape, 0, 256).astype(dtype)


def timed(line: dict[str, Any], name: str, run: Callable[[], Any]) -> Any:
    begun = time.perf_counter()
    answer = jax.block_until_ready(run())
    line[name] = time.perf_counter() - begun
    return answer


def tera(flops: float, seconds: float) -> float:
    return flops / seconds / 1e12


def speed(flops: float, seconds: float) -> dict[str, float]:
    rate = flops / seconds
    return {"tflops": rate / 1e12, "mfu": rate / peak(jax.devices()[0].device_kind)}


def taken() -> float:
    """GiB at the worst moment since the process began."""
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0) / GIB
