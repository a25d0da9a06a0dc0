"""Our video transformer, jitted, against diffusers', eager, on two CPU threads in float32.

A text-to-video network of 2 layers (width 1536, 12 heads, MLP 8960) on latents of 6 x 32 x 32 and
512 text tokens; both hold the same weights and are checked to agree. Calls alternate, so that a
busy neighbor slows both, and each pair gives one ratio of times, ours to theirs: reported is the
median with an interval of at least 95 % by order statistics, and the median ratio of
processor seconds, which neighbors touch less.

    python -m tests.benchmarks.bench_wan_dit [--pairs 11]
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from math import comb
from statistics import median
from typing import NamedTuple

import tyro

THREADS = 2
GOALS = {"forward": 1.02, "forward and backward": 1.25}
"""Ratio of times, ours to theirs, that must not be exceeded."""


class Seconds(NamedTuple):
    """Seconds of one call."""

    wall: float
    processor: float


def main(pairs: int = 11) -> None:
    """Time both networks.

    Args:
        pairs: Interleaved pairs of calls, at least 9.
    """
    if pairs < 9:
        raise SystemExit(f"--pairs must be at least 9, not {pairs}.")
    # XLA takes its number of threads from the process's processors, before it starts.
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:THREADS])
    for name, (ours, theirs) in programs().items():
        times = interleave(ours, theirs, pairs)
        ratios = sorted(ours.wall / theirs.wall for ours, theirs in times)
        low, high, level = interval(pairs)
        print(
            f"{name}: ours {median(ours.wall for ours, _ in times):.2f} s, "
            f"diffusers {median(theirs.wall for _, theirs in times):.2f} s, "
            f"ratio {median(ratios):.3f} [{ratios[low]:.3f}, {ratios[high]:.3f}] "
            f"({level:.1%}, {pairs} pairs), of processor seconds "
            f"{median(ours.processor / theirs.processor for ours, theirs in times):.3f}; "
            f"goal {GOALS[name]}: {'met' if median(ratios) <= GOALS[name] else 'MISSED'}",
            flush=True,
        )


def programs() -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """The timed calls, ours and theirs; each returns when its result is there."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    import torch
    from diffusers import WanTransformer3DModel
    from einops import rearrange
    from flax import nnx

    from egosim_jax.convert.tables import wan_dit as table
    from egosim_jax.io.weights import fill
    from egosim_jax.models.wan.dit import WanDiT, WanDiTConfig
    from tests.translation import translate

    torch.set_num_threads(THREADS)
    torch.manual_seed(0)
    config = WanDiTConfig(
        in_channels=16, dim=1536, heads=12, ffn_dim=8960, layers=2, image_dim=None
    )
    theirs = WanTransformer3DModel(
        num_attention_heads=config.heads,
        attention_head_dim=config.head_dim,
        in_channels=config.in_channels,
        out_channels=config.out_channels,
        text_dim=config.text_dim,
        ffn_dim=config.ffn_dim,
        num_layers=config.layers,
        cross_attn_norm=True,
    )
    ours = nnx.eval_shape(lambda: WanDiT(config, rngs=nnx.Rngs(0)))
    state = {name: tensor.numpy() for name, tensor in theirs.state_dict().items()}
    fill(ours, translate(state, table.diffusers(config)))
    graph, weights = nnx.split(ours)

    draw = np.random.default_rng(0).standard_normal
    latents, text = draw((1, 6, 32, 32, 16)), draw((1, 512, config.text_dim))
    inputs = [jnp.asarray(x, jnp.float32) for x in (latents, [500.0], text)]
    their_inputs = [
        torch.tensor(x, dtype=torch.float32)
        for x in (rearrange(latents, "b f h w c -> b c f h w"), [500.0], text)
    ]

    def velocity(weights: nnx.State, *inputs: jax.Array) -> jax.Array:
        return nnx.merge(graph, weights)(*inputs)

    def mean_square(weights: nnx.State, *inputs: jax.Array) -> jax.Array:
        return jnp.square(velocity(weights, *inputs)).mean()

    forward = jax.jit(velocity).lower(weights, *inputs).compile()
    backward = jax.jit(jax.value_and_grad(mean_square)).lower(weights, *inputs).compile()

    def their_forward() -> torch.Tensor:
        with torch.no_grad():
            return theirs(*their_inputs, return_dict=False)[0]

    def their_backward() -> torch.Tensor:
        theirs.zero_grad()
        loss = theirs(*their_inputs, return_dict=False)[0].square().mean()
        loss.backward()
        return loss.detach()

    have = np.asarray(forward(weights, *inputs))
    want = rearrange(their_forward().numpy(), "b c f h w -> b f h w c")
    np.testing.assert_array_less(np.linalg.norm(have - want), 1e-5 * np.linalg.norm(want))
    return {
        "forward": (lambda: jax.block_until_ready(forward(weights, *inputs)), their_forward),
        "forward and backward": (
            lambda: jax.block_until_ready(backward(weights, *inputs)),
            their_backward,
        ),
    }


def interleave(
    ours: Callable[[], object], theirs: Callable[[], object], pairs: int
) -> list[tuple[Seconds, Seconds]]:
    """Times of both for each pair, after one warm-up; who goes first changes every time."""
    ours(), theirs()
    times = []
    for pair in range(pairs):
        if pair % 2:
            second, first = measure(theirs), measure(ours)
        else:
            first, second = measure(ours), measure(theirs)
        times.append((first, second))
    return times


def measure(call: Callable[[], object]) -> Seconds:
    """Time one call."""
    wall, processor = time.perf_counter(), time.process_time()
    call()
    return Seconds(time.perf_counter() - wall, time.process_time() - processor)


def interval(count: int) -> tuple[int, int, float]:
    """Places, in the sorted sample, of the bounds of the median, and the confidence they give.

    The median lies below the k-th of n values with the probability of fewer than k heads in n
    tosses, whatever the distribution: the narrowest symmetric places that reach 95 %.
    """
    below, tail = 0, 2**-count
    while tail + comb(count, below + 1) * 2**-count <= 0.025:
        below += 1
        tail += comb(count, below) * 2**-count
    return below, count - 1 - below, 1 - 2 * tail


if __name__ == "__main__":
    tyro.cli(main)
