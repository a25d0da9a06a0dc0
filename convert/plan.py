"""What a conversion will write, weight by weight, before anything is read but headers."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from egosim_jax.convert.layouts import Found, Naming, Network
from egosim_jax.convert.rules import Leaf, Rule, assign, shape_only
from egosim_jax.convert.skeleton import shapes
from egosim_jax.convert.stream import Weight, stored_as
from egosim_jax.io.mapped import Tensor
from egosim_jax.io.weights import WeightsError, mismatches
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.models.lora import Change
    from egosim_jax.models.wan.config import WanDiTConfig
    from egosim_jax.networks import ModelConfig

TABLES: dict[Network, str] = {
    "dit": "wan_dit",
    "vae": "wan_vae",
    "text": "umt5",
    "image": "clip_vision",
}
"""Name table of each network of a model."""
Widening = Literal["copy", "polarity"]
BASE_CHANNELS, MASK = 36, slice(16, 20)
"""Channels that the Wan image-to-video models read, and those of the mask among them."""
KERNEL, BIAS = "patch.kernel", "patch.bias"


def to_ours(
    found: Found, config: ModelConfig, *, dtype: str | None = None, widen: Widening | None = None
) -> list[Weight]:
    """The weights of the config's network, made from a foreign checkpoint.

    `widen` takes a video transformer of 36 channels for one of 52: the kernel of the hands'
    channels is 0. With `copy` the others are as they were; with `polarity` the mask's are
    re-expressed, since the base models' mask is 1 where ours is 0. Raises `WeightsError` with all
    that differs.
    """
    shape = _shape(config, found.network)
    read = _narrow(config, found) if widen else shape
    leaves, tensors = _leaves(found, read), found.tensors
    weights = {
        path: Weight(
            name=path,
            shape=leaf.shape,
            dtype=stored_as(leaf.dtype, dtype),
            pieces=tuple(partial(_ours, leaf.rule, tensors[name]) for name in leaf.names),
        )
        for path, leaf in leaves.items()
    }
    if widen:
        _widen(weights, channels=shape.in_channels, how=widen)
    return list(weights.values())


def to_theirs(
    tensors: Mapping[str, Tensor],
    config: ModelConfig,
    network: Network,
    naming: Naming,
    *,
    dtype: str | None = None,
) -> list[Weight]:
    """The foreign tensors of a naming, made from a file of ours.

    Raises `WeightsError` if the file is not of the config's network, and `InputError` for a naming
    that the network does not have.
    """
    shape = _shape(config, network)
    if problems := mismatches(tensors, shapes(network, shape)):
        raise WeightsError(problems, source=f"{network}.safetensors")
    parts: dict[str, dict[int, _Part]] = {}
    for rule in _rules(network, naming, shape):
        tensor = tensors[rule.target]
        for layer in range(tensor.shape[0]) if rule.stacked else (None,):
            name = rule.source if layer is None else rule.source.replace("*", str(layer))
            part = _Part(rule=rule, tensor=tensor, layer=layer)
            parts.setdefault(name, {})[rule.part[0]] = part
    weights = []
    for name, numbered in parts.items():
        group = tuple(numbered[i] for i in sorted(numbered))
        weights.append(
            Weight(
                name=name,
                shape=_fused([part.shape() for part in group]).shape,
                dtype=stored_as(group[0].tensor.dtype, dtype),
                pieces=(partial(_theirs, group),),
            )
        )
    return weights


def merged(
    tensors: Mapping[str, Tensor],
    changes: Mapping[str, Change],
    config: WanDiTConfig,
    *,
    scale: float,
) -> list[Weight]:
    """The weights of a video transformer with a LoRA in them, in their own dtypes.

    Raises `InputError` if the weights or the LoRA are not of the config.
    """
    from egosim_jax.models import lora

    want = shapes("dit", config)
    if problems := mismatches(tensors, want):
        raise WeightsError(problems, source="dit.safetensors")
    lora.check_scale(scale)
    lora.check(want, changes)

    def piece(path: str, layer: int | None) -> np.ndarray:
        at = ... if layer is None else layer
        weight = tensors[path].array()[at]
        low, whole = changes.get(path.removesuffix(".kernel")), changes.get(path)
        added = []
        if path.endswith(".kernel") and isinstance(low, lora.Delta):
            added.append(low.down[at] @ low.up[at])
        if isinstance(whole, np.ndarray):
            added.append(whole[at])
        return weight.astype(np.float32) + scale * sum(added) if added else weight

    weights = []
    for path, tensor in tensors.items():
        layers = range(tensor.shape[0]) if path.startswith("blocks.") else (None,)
        pieces = tuple(partial(piece, path, layer) for layer in layers)
        weights.append(Weight(name=path, shape=tensor.shape, dtype=tensor.dtype, pieces=pieces))
    return weights


def fits(found: Found, config: ModelConfig) -> bool:
    """Whether the checkpoint fills the config's network."""
    try:
        _leaves(found, _shape(config, found.network))
    except InputError:
        return False
    return True


@dataclass(frozen=True, kw_only=True)
class _Part:
    """What one rule gives to a foreign tensor."""

    rule: Rule
    tensor: Tensor
    layer: int | None

    def array(self) -> np.ndarray:
        """Its values."""
        ours = self.tensor.array()
        return self.rule.to_torch(ours if self.layer is None else ours[self.layer])

    def shape(self) -> np.ndarray:
        """An array of its shape that takes no memory."""
        ours = shape_only(self.tensor)
        return self.rule.to_torch(ours if self.layer is None else ours[self.layer])


def _ours(rule: Rule, tensor: Tensor) -> np.ndarray:
    return rule.to_jax(tensor.array())


def _theirs(parts: Sequence[_Part]) -> np.ndarray:
    return _fused([part.array() for part in parts])


def _fused(arrays: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate(arrays) if len(arrays) > 1 else arrays[0]


def _leaves(found: Found, shape: Any) -> dict[str, Leaf]:
    return assign(
        found.tensors,
        _rules(found.network, found.naming, shape),
        ignore=_table(found.network).ignored(shape),
        want=shapes(found.network, shape),
        source=found.source.name,
    )


def _shape(config: ModelConfig, network: Network) -> Any:
    """The network's own config."""
    shape = getattr(config, network)
    if shape is None:
        raise InputError(f"{config.name} has no network {network}. (--config, --only)")
    return shape


def _rules(network: Network, naming: Naming, shape: Any) -> list[Rule]:
    rules = getattr(_table(network), naming, None)
    if rules is None:
        raise InputError(f"There are no {naming} names of the network {network}. (--naming)")
    return rules(shape)


def _table(network: Network) -> ModuleType:
    return importlib.import_module(f"egosim_jax.convert.tables.{TABLES[network]}")


def _narrow(config: ModelConfig, found: Found) -> Any:
    """The config of the base model of a wider one."""
    if found.network != "dit" or config.dit.in_channels <= BASE_CHANNELS:
        raise InputError(
            f"{config.name} reads {config.dit.in_channels} channels: only a video transformer of "
            f"more than {BASE_CHANNELS} is widened. (--widen, --only dit)"
        )
    return replace(config.dit, in_channels=BASE_CHANNELS)


def _widen(weights: dict[str, Weight], *, channels: int, how: Widening) -> None:
    """Read more channels: further ones do not count until they are trained."""
    kernel, bias = weights[KERNEL], weights[BIAS]
    (make_kernel,), (make_bias,) = kernel.pieces, bias.pieces
    more = channels - BASE_CHANNELS

    def wide() -> np.ndarray:
        base = make_kernel().copy()
        if how == "polarity":
            base[MASK] = -base[MASK]
        return np.pad(base, [(0, more), (0, 0), (0, 0), (0, 0)])

    def shifted() -> np.ndarray:
        # k m = k - k (1 - m): what the mask's kernel sums to goes into the bias.
        mask = make_kernel()[MASK].astype(np.float64).sum(axis=(0, 1, 2))
        return make_bias().astype(np.float64) + mask

    weights[KERNEL] = replace(kernel, shape=(channels, *kernel.shape[1:]), pieces=(wide,))
    if how == "polarity":
        weights[BIAS] = replace(bias, pieces=(shifted,))
