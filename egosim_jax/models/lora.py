"""Low-rank adaptation (LoRA) of linear layers.

A layer y = x W + b becomes y = x W + b + s (x A) B with A `[in, r]`, B `[r, out]` and s = alpha / r
times the scale that a user asks for. Merged, the same is W + s A B. Source: Hu et al. 2021, LoRA,
section 4.1.

Which layers are adapted, and which weights are trained in full along with them, is said by the
denoiser's config (`lora_targets`, `also_train`) in patterns of dotted paths.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float

from egosim_jax.io.bounded import listing, quote_path, quote_text
from egosim_jax.io.mapped import OURS, read_metadata, read_safetensors
from egosim_jax.io.weights import flat_shapes
from egosim_jax.models.layers import Linear, LowRank, LowRankParam
from egosim_jax.types import InputError

T = TypeVar("T")
BASE = "base_sha256"
"""Metadata key of the hash of the weights that the LoRA was trained on."""
DIFF, VALUE = ".diff", ".value"
"""Ends of the names of a change to a weight in full and of its new value, in a file."""


@dataclass(frozen=True, kw_only=True)
class Delta:
    """Low-rank change of a linear layer, or of that layer in every block of a stack."""

    down: Float[np.ndarray, "*l i r"]
    """Matrix A of the low-rank product."""
    up: Float[np.ndarray, "*l r o"]
    """Matrix B, multiplied by alpha / r."""


@dataclass(frozen=True, kw_only=True)
class Value:
    """Full value that replaces a weight, such as DWM's patch projection."""

    array: np.ndarray
    """New value of the weight."""


Change = Delta | Value | np.ndarray
"""Low-rank change of the linear layer at a path, or value or difference of the weight at a path."""
MAX_SCALE = float(np.finfo(np.float32).max)
"""Maximum absolute scale."""
MAX_RANK = 2048
"""Maximum rank; with the network's own widths it bounds the memory."""


def linears(network: Any) -> Iterator[tuple[str, Linear]]:
    """Yield the linear layers of a network with their dotted paths."""
    for path, module in nnx.iter_modules(network):
        if isinstance(module, Linear):
            yield ".".join(map(str, path)), module


def apply(network: Any, changes: Mapping[str, Change], *, scale: float = 1.0) -> None:
    """Apply changes to a network in place; low-rank ones are kept apart, in float32.

    Raises `InputError` as `check` does.
    """
    check_scale(scale)
    check(flat_shapes(network), changes)
    layers = dict(linears(network))
    low = [path for path, change in changes.items() if isinstance(change, Delta)]
    refuse([f"{path}: is not a linear layer" for path in low if path not in layers])
    state = nnx.state(network, nnx.Param)
    weights = {".".join(map(str, path)): leaf for path, leaf in nnx.to_flat_state(state)}
    for path, change in changes.items():
        if not isinstance(change, Delta):
            value = weights[path].get_value()
            given = change.array if isinstance(change, Value) else change
            full = jnp.asarray(given, jnp.float32)
            full = full - value if isinstance(change, Value) else full
            weights[path].set_value((value + scale * full).astype(value.dtype))
    nnx.update(network, state)
    for path, change in changes.items():
        if isinstance(change, Delta):
            down, up = (jnp.asarray(array, jnp.float32) for array in (change.down, change.up))
            scaled = scale * up
            if not jnp.isfinite(scaled).all():
                raise InputError(
                    f"The scale {scale:g} makes values of {path} that float32 cannot hold. Lower "
                    "it. (--lora-scale)"
                )
            layers[path].low_rank = LowRank(down, scaled)


def merge(network: Any, path: Path, *, base: str) -> None:
    """Add the low-rank changes of one of our files to the weights of a network, in place.

    Raises `InputError` if the file names base weights of another hash, or does not fit.
    """
    if (own := read_metadata(path).get(BASE)) != base:
        raise InputError(
            f"{quote_path(path)} is a LoRA of weights with the hash {quote_text(str(own)[:12])}, "
            f"but those next to it have {base[:12]}. Give the weights that it was trained on. "
            "(--weights)"
        )
    tensors = {name: tensor.array() for name, tensor in read_safetensors(path).items()}
    changes = from_tensors(tensors)
    check(flat_shapes(network), changes)
    full = {}
    for name, change in changes.items():
        if isinstance(change, Delta):
            low = (np.asarray(array, np.float32) for array in (change.down, change.up))
            full[f"{name}.kernel"] = np.matmul(*low)
        else:
            full[name] = change
    apply(network, full)


def deltas_of(network: Any) -> dict[str, Delta]:
    """Return the low-rank changes of a network by the path of their layer."""
    return {
        path: Delta(
            down=np.asarray(layer.low_rank.down.get_value()),
            up=np.asarray(layer.low_rank.up.get_value()),
        )
        for path, layer in linears(network)
        if layer.low_rank is not None
    }


def full_weights(network: Any, patterns: Sequence[str]) -> dict[str, Any]:
    """Return the weights whose paths match `also_train` patterns, without low-rank ones."""
    kind = nnx.All(nnx.Param, nnx.Not(LowRankParam))
    leaves = nnx.to_flat_state(nnx.state(network, kind))
    named = {".".join(map(str, path)): leaf.get_value() for path, leaf in leaves}
    return {path: value for path, value in named.items() if matches(path, patterns)}


def tensors(changes: Mapping[str, Change]) -> dict[str, np.ndarray]:
    """Return changes as a file's tensors: a path with `down` and `up`, `diff` or `value`."""
    named = {}
    for path, change in changes.items():
        if isinstance(change, Delta):
            named |= {f"{path}.down": change.down, f"{path}.up": change.up}
        elif isinstance(change, Value):
            named[f"{path}{VALUE}"] = change.array
        else:
            named[f"{path}{DIFF}"] = change
    return named


def from_tensors(tensors: Mapping[str, np.ndarray]) -> dict[str, Change]:
    """Return the changes of a file's tensors. Raises `InputError` naming incomplete pairs."""
    low = {path: Delta(down=down, up=up) for path, (down, up) in pairs(tensors).items()}
    full = {n.removesuffix(DIFF): tensor for n, tensor in tensors.items() if n.endswith(DIFF)}
    values = {
        name.removesuffix(VALUE): Value(array=tensor)
        for name, tensor in tensors.items()
        if name.endswith(VALUE)
    }
    return {**low, **full, **values}


def pairs(tensors: Mapping[str, T]) -> dict[str, tuple[T, T]]:
    """Return the tensors named `down` and `up` by path.

    Raises `InputError` naming incomplete pairs; weights that are trained in full are skipped.
    """
    names = {name for name in tensors if not name.endswith((DIFF, VALUE))}
    paths = sorted({name.rpartition(".")[0] for name in names})
    both = {name for path in paths for name in (f"{path}.down", f"{path}.up")}
    if odd := sorted(both ^ names):
        raise InputError(f"The LoRA has incomplete pairs of down and up: {listing(odd)}.")
    return {path: (tensors[f"{path}.down"], tensors[f"{path}.up"]) for path in paths}


def metadata(config: str, *, base: str) -> dict[str, str]:
    """Return the metadata of a file; `base` is the hash of the weights that it was trained on."""
    return {"format": OURS, "config": config, BASE: base}


def read_own(path: Path, *, convert: str) -> dict[str, Change]:
    """Return the changes of one of our files.

    Raises `InputError` for a LoRA in another format; `convert` is the command that writes ours.
    """
    if path.is_dir() or path.suffix != ".safetensors" or read_metadata(path).get("format") != OURS:
        raise InputError(
            f"{quote_path(path)} is a LoRA in the names of another project. Write it in ours, and "
            f"give the new file: {convert} (--lora)"
        )
    return from_tensors({name: t.array() for name, t in read_safetensors(path).items()})


def check_further(changes: Mapping[str, Change], abstract: nnx.State) -> None:
    """Raise `InputError` unless changes are of weights that `abstract`, a training's, has.

    A lower rank is no error.
    """
    leaves, problems = _leaves(abstract), []
    for path, change in changes.items():
        shapes = [leaf.shape for _, (_, leaf) in sorted(leaves.get(path, {}).items())]
        if len(shapes) != (2 if isinstance(change, Delta) else 1):
            problems.append(f"{path}: is not trained here")
        elif isinstance(change, Delta):
            (*stacked, wide, rank), (*_, out) = shapes
            kernel = {f"{path}.kernel": (*stacked, wide, out)}
            why = misfit(kernel, path, change.down.shape, change.up.shape)
            if why is None and (has := change.down.shape[-1]) > rank:
                why = f"has rank {has}; the training has {rank} (--rank)"
            problems += [f"{path}: {why}"] if why else []
        else:
            have = (change.array if isinstance(change, Value) else change).shape
            problems += [] if have == shapes[0] else [f"{path}: has shape {have}, not {shapes[0]}"]
    if problems:
        raise InputError(
            f"The LoRA cannot be trained further: {listing(problems)}. Train with its rank and "
            "model, or merge it into the weights. (--lora, egosim convert lora --merge)"
        )


def state_of(changes: Mapping[str, Change], abstract: nnx.State, base: nnx.State) -> nnx.State:
    """Return the weights that a training with the weights `abstract` continues a LoRA from.

    `base` has the weights before the LoRA. Layers, blocks and ranks without a change start as in
    `start`.
    """
    before, trained, state = dict(nnx.to_flat_state(base)), _leaves(abstract), []
    rng = np.random.default_rng(0)
    for path, change in changes.items():
        keys, leaves = zip(*(leaf for _, leaf in sorted(trained[path].items())), strict=True)
        if isinstance(change, Delta):
            down, up = (np.zeros(tuple(leaf.shape), np.float32) for leaf in leaves)
            *_, wide, rank = change.down.shape
            bound = wide**-0.5
            down[..., :rank], up[..., :rank, :] = change.down, change.up
            # Where both factors are 0, so are their gradients: it would never learn.
            empty = ~(down.any(axis=-2, keepdims=True) | np.any(up, axis=-1)[..., None, :])
            down = np.where(empty, rng.uniform(-bound, bound, down.shape), down)
            arrays = [jnp.asarray(array, jnp.float32) for array in (down, up)]
        elif isinstance(change, Value):
            arrays = [jnp.asarray(change.array, jnp.float32)]
        else:
            arrays = [before[keys[0]].get_value() + change]
        state += [(k, leaf.replace(a)) for k, leaf, a in zip(keys, leaves, arrays, strict=True)]
    return nnx.from_flat_state(state)


def _leaves(abstract: nnx.State) -> dict[str, dict[str, tuple[Any, nnx.Variable]]]:
    """Return the trained weights by the path that they have in a file: `down` and `up`, or one."""
    leaves: dict[str, dict[str, tuple[Any, nnx.Variable]]] = {}
    for key, leaf in nnx.to_flat_state(abstract):
        # A path in a file has no names of the network and of the layer's low-rank part.
        low = isinstance(leaf, LowRankParam)
        path = ".".join(map(str, key[1:-2] if low else key[1:]))
        leaves.setdefault(path, {})[str(key[-1]) if low else ""] = key, leaf
    return leaves


def start(
    network: Any,
    rank: int,
    *,
    targets: Sequence[str],
    also_train: Sequence[str] = (),
    rngs: nnx.Rngs,
) -> None:
    """Add trainable low-rank changes to the linear layers that match `targets`, in place.

    A is drawn as PEFT does, uniformly from ±1 / sqrt(in) (Kaiming's with a = sqrt(5)), and B is 0,
    so the network does not change before the first update. Raises `InputError` if no linear layer
    matches `targets`, or no weight matches a pattern of `also_train`.
    """
    if rank < 1:
        raise InputError(f"The rank of a LoRA must be at least 1, not {rank}.")
    layers = [layer for path, layer in linears(network) if matches(path, targets)]
    if not layers:
        raise InputError(
            "A LoRA needs a linear layer: none matches the denoiser's patterns "
            f"{listing(targets)}. Correct its config, or train all weights. (lora_targets, --rank)"
        )
    weights = flat_shapes(network)
    if bad := [p for p in also_train if not any(matches(path, [p]) for path in weights)]:
        raise InputError(
            "Every pattern of weights to train in full must match one: the denoiser has none of "
            f"{listing(bad)}. Correct its config. (also_train)"
        )
    for layer in layers:
        *stacked, wide, out = layer.kernel.shape
        bound = wide**-0.5
        down = jax.random.uniform(
            rngs.params(), (*stacked, wide, rank), minval=-bound, maxval=bound
        )
        layer.low_rank = LowRank(down, jnp.zeros((*stacked, rank, out)))


def trained(also_train: Sequence[str]) -> Any:
    """Return the nnx filter of a LoRA's weights and of the denoiser's weights trained in full."""

    def in_full(path: tuple[Any, ...], _: Any) -> bool:
        network, *inner = map(str, path)
        return network == "dit" and matches(".".join(inner), also_train)

    return nnx.Any(LowRankParam, in_full) if also_train else LowRankParam


def matches(path: str, patterns: Sequence[str]) -> bool:
    """Return whether a dotted path matches one of the patterns, in which * also matches dots."""
    return any(fnmatchcase(path, pattern) for pattern in patterns)


def check_scale(scale: float) -> None:
    """Raise `InputError` unless a LoRA's scale is finite, also in float32."""
    if not abs(scale) <= MAX_SCALE:  # also for NaN
        raise InputError(
            f"A LoRA's scale must be a finite number of at most {MAX_SCALE:.2g}, not {scale}. "
            "(--scale, --lora-scale)"
        )


def check(shapes: Mapping[str, tuple[int, ...]], changes: Mapping[str, Change]) -> None:
    """Raise `InputError` naming every change that does not fit the weights, or is not finite."""
    problems = []
    for path, change in changes.items():
        if isinstance(change, Delta):
            why = misfit(shapes, path, change.down.shape, change.up.shape)
            arrays = (change.down, change.up)
        else:
            full = change.array if isinstance(change, Value) else change
            arrays, want = (full,), shapes.get(path)
            why = None if full.shape == want else f"has shape {full.shape}; expected {want}"
        if why is None and not all(np.isfinite(array).all() for array in arrays):
            why = "has values that are not finite"
        if why is not None:
            problems.append(f"{path}: {why}")
    refuse(problems)


def misfit(
    shapes: Mapping[str, tuple[int, ...]], path: str, down: tuple[int, ...], up: tuple[int, ...]
) -> str | None:
    """Return why a pair of these shapes does not fit the linear layer at a path, or None."""
    kernel = shapes.get(f"{path}.kernel", ())
    if len(kernel) not in (2, 3):  # of one layer, or of a stack of them
        return "is not a linear layer"
    *stacked, wide, out = kernel
    rank = down[-1] if down else 0
    if not 1 <= rank <= MAX_RANK:
        return f"has rank {rank}; expected 1 to {MAX_RANK}"
    want = ((*stacked, wide, rank), (*stacked, rank, out))
    if (down, up) == want:
        return None
    return f"has shapes {down} and {up}; expected {want[0]} and {want[1]}"


def refuse(problems: Sequence[str]) -> None:
    """Raise `InputError` if there are problems."""
    if problems:
        raise InputError(f"The LoRA does not fit this network: {listing(problems)}.")
