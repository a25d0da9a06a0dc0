"""Low-rank additions to linear layers.

A layer y = x W + b becomes y = x W + b + s (x A) B with A `[in, r]`, B `[r, out]` and s = alpha / r
times what a user asks for. Merged, the same is W + s A B. Source: Hu et al. 2021, LoRA, section
4.1.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float

from egosim_jax.io.mapped import OURS
from egosim_jax.io.untrusted import listing
from egosim_jax.io.weights import flat_shapes
from egosim_jax.models.layers import Linear, LowRank
from egosim_jax.types import InputError

T = TypeVar("T")
BASE = "base_sha256"
"""In that header: the hash of the weights that the LoRA was trained on."""


@dataclass(frozen=True, kw_only=True)
class Delta:
    """What is added to one linear layer, or to a layer of every block of a stack."""

    down: Float[np.ndarray, "*l i r"]
    """A."""
    up: Float[np.ndarray, "*l r o"]
    """B, with alpha / r in it."""


Change = Delta | np.ndarray
"""What a file adds: to a linear layer, of this path; or all of it to the weight of this path."""
MOST_RANK = 2048
"""Highest rank that is read; with the network's own widths it bounds the memory."""


def linears(network: Any) -> Iterator[tuple[str, Linear]]:
    """The linear layers of a network by their dotted paths."""
    for path, module in nnx.iter_modules(network):
        if isinstance(module, Linear):
            yield ".".join(map(str, path)), module


def apply(network: Any, changes: Mapping[str, Change], *, scale: float = 1.0) -> None:
    """Add summands to the layers and weights of these paths, in place; low-rank ones stay apart.

    Raises what `check` raises.
    """
    check_scale(scale)
    check(flat_shapes(network), changes)
    layers = dict(linears(network))
    state = nnx.state(network, nnx.Param)
    weights = {".".join(map(str, path)): leaf for path, leaf in nnx.to_flat_state(state)}
    for path, change in changes.items():
        if not isinstance(change, Delta):
            value = weights[path].get_value()
            weights[path].set_value((value + scale * jnp.asarray(change)).astype(value.dtype))
    nnx.update(network, state)
    for path, change in changes.items():
        if isinstance(change, Delta):
            up = jnp.asarray(scale * change.up)
            layers[path].low_rank = LowRank(jnp.asarray(change.down), up)


def deltas_of(network: Any) -> dict[str, Delta]:
    """What was added to the layers that have a summand."""
    return {
        path: Delta(
            down=np.asarray(layer.low_rank.down.get_value()),
            up=np.asarray(layer.low_rank.up.get_value()),
        )
        for path, layer in linears(network)
        if layer.low_rank is not None
    }


def tensors(deltas: Mapping[str, Delta]) -> dict[str, np.ndarray]:
    """Our own names of summands in a file: a layer's path, then `down` or `up`."""
    return {
        f"{path}.{part}": getattr(delta, part)
        for path, delta in deltas.items()
        for part in ("down", "up")
    }


def from_tensors(tensors: Mapping[str, np.ndarray]) -> dict[str, Delta]:
    """The inverse of `tensors`. Raises `InputError` naming what is of no pair."""
    return {path: Delta(down=down, up=up) for path, (down, up) in pairs(tensors).items()}


def pairs(tensors: Mapping[str, T]) -> dict[str, tuple[T, T]]:
    """What is named `down` and `up`, by path. Raises `InputError` naming what is of no pair."""
    paths = sorted({name.rpartition(".")[0] for name in tensors})
    both = {name for path in paths for name in (f"{path}.down", f"{path}.up")}
    if odd := sorted(both ^ tensors.keys()):
        raise InputError(f"The LoRA has no pairs of down and up of these: {listing(odd)}.")
    return {path: (tensors[f"{path}.down"], tensors[f"{path}.up"]) for path in paths}


def about(config: str, *, base: str) -> dict[str, str]:
    """The header of a file in our own names; `base` is the hash of what it was trained on."""
    return {"format": OURS, "config": config, BASE: base}


def start(network: Any, rank: int, *, rngs: nnx.Rngs) -> None:
    """Add summands of a rank to every linear layer of the blocks, in place, to train.

    A is drawn as the paper does, from a normal distribution of deviation 1 / sqrt(in), and B is 0,
    so that nothing changes before the first update.
    """
    if rank < 1:
        raise InputError(f"A LoRA has a rank of at least 1, not {rank}.")
    for path, layer in linears(network):
        if path.startswith("blocks."):
            *stacked, wide, out = layer.kernel.shape
            down = jax.random.normal(rngs.params(), (*stacked, wide, rank)) / wide**0.5
            layer.low_rank = LowRank(down, jnp.zeros((*stacked, rank, out)))


def check_scale(scale: float) -> None:
    """Raise `InputError` for what is no strength of a LoRA."""
    if not math.isfinite(scale):
        raise InputError(f"A LoRA's scale is a finite number, not {scale}. (--scale)")


def check(shapes: Mapping[str, tuple[int, ...]], changes: Mapping[str, Change]) -> None:
    """Raise `InputError` naming every summand that does not fit the weights, or is not finite."""
    problems = []
    for path, change in changes.items():
        if isinstance(change, Delta):
            why = misfit(shapes, path, change.down.shape, change.up.shape)
            arrays = (change.down, change.up)
        else:
            arrays, want = (change,), shapes.get(path)
            why = f"have {change.shape}, want {want}" if change.shape != want else None
        if why is None and not all(np.isfinite(array).all() for array in arrays):
            why = "has values that are not finite"
        if why is not None:
            problems.append(f"{path}: {why}")
    refuse(problems)


def misfit(
    shapes: Mapping[str, tuple[int, ...]], path: str, down: tuple[int, ...], up: tuple[int, ...]
) -> str | None:
    """Say why a pair of such shapes does not fit the linear layer of a path, if it does not."""
    kernel = shapes.get(f"{path}.kernel", ())
    if len(kernel) != (3 if path.startswith("blocks.") else 2):
        return "is no linear layer"
    *stacked, wide, out = kernel
    rank = down[-1] if down else 0
    if not 1 <= rank <= MOST_RANK:
        return f"has rank {rank}, want 1 to {MOST_RANK}"
    want = ((*stacked, wide, rank), (*stacked, rank, out))
    return None if (down, up) == want else f"have {down} and {up}, want {want[0]} and {want[1]}"


def refuse(problems: Sequence[str]) -> None:
    """Raise `InputError` if there are problems."""
    if problems:
        raise InputError(f"The LoRA is not of this network: {listing(problems)}.")
