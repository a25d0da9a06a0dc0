"""Low-rank additions to linear layers.

A layer y = x W + b becomes y = x W + b + s (x A) B with A `[in, r]`, B `[r, out]` and s = alpha / r
times what a user asks for. Merged, the same is W + s A B. Source: Hu et al. 2021, LoRA, section
4.1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float

from egosim_jax.models.layers import Linear, LowRank
from egosim_jax.types import InputError

OURS = "egosim_jax"
"""The format that a file's header names if its names are ours."""
BASE = "base_sha256"
"""In that header: the hash of the weights that the LoRA was trained on."""


@dataclass(frozen=True, kw_only=True)
class Delta:
    """What is added to one linear layer, or to a layer of every block of a stack."""

    down: Float[np.ndarray, "*l i r"]
    """A."""
    up: Float[np.ndarray, "*l r o"]
    """B, with alpha / r in it."""


def linears(network: nnx.Module) -> Iterator[tuple[str, Linear]]:
    """The linear layers of a network by their dotted paths."""
    for path, module in nnx.iter_modules(network):
        if isinstance(module, Linear):
            yield ".".join(map(str, path)), module


def apply(network: nnx.Module, deltas: Mapping[str, Delta], *, scale: float = 1.0) -> None:
    """Add low-rank summands to the layers of these paths, in place; the kernels stay.

    Raises what `check` raises.
    """
    check(network, deltas)
    layers = dict(linears(network))
    for path, delta in deltas.items():
        layers[path].low_rank = LowRank(jnp.asarray(delta.down), jnp.asarray(scale * delta.up))


def deltas_of(network: nnx.Module) -> dict[str, Delta]:
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
    paths = {name.rpartition(".")[0] for name in tensors}
    pairs = {name for path in paths for name in (f"{path}.down", f"{path}.up")}
    if odd := sorted(pairs ^ tensors.keys()):
        raise InputError(f"The LoRA has no pairs of down and up of {', '.join(odd)}.")
    return {
        path: Delta(down=tensors[f"{path}.down"], up=tensors[f"{path}.up"])
        for path in sorted(paths)
    }


def about(config: str, *, base: str) -> dict[str, str]:
    """The header of a file in our own names; `base` is the hash of what it was trained on."""
    return {"format": OURS, "config": config, BASE: base}


def start(network: nnx.Module, rank: int, *, rngs: nnx.Rngs) -> None:
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


def check(network: nnx.Module, deltas: Mapping[str, Delta]) -> None:
    """Raise `InputError` naming every summand that is not of a layer or does not fit it."""
    layers = dict(linears(network))
    problems = []
    for path, delta in deltas.items():
        if path not in layers:
            problems.append(f"{path} is no linear layer")
            continue
        *stacked, wide, out = layers[path].kernel.shape
        rank = delta.down.shape[-1]
        want = ((*stacked, wide, rank), (*stacked, rank, out))
        if (delta.down.shape, delta.up.shape) != want:
            problems.append(f"{path}: have {delta.down.shape} and {delta.up.shape}, want {want}")
    if problems:
        listing = "\n".join(f"  {line}" for line in problems)
        raise InputError(f"The LoRA is not of this network:\n{listing}")
