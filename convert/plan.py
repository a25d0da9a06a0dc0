"""Plan of a conversion, weight by weight, from headers alone; values are read when written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from egosim_jax.convert.detect import DetectedNetwork
from egosim_jax.convert.finite import all_finite
from egosim_jax.convert.rules import Leaf, Rule, assign, shape_only
from egosim_jax.convert.tables import table_of, weight_shapes
from egosim_jax.convert.widen import Widening, WidenMode
from egosim_jax.convert.writer import Weight, stored_as
from egosim_jax.io.mapped import Tensor
from egosim_jax.io.weights import WeightsError, mismatches
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig
    from egosim_jax.models import NetworkConfig
    from egosim_jax.models.lora import Change

NO_WEIGHTS = ("spiece_model", "*position_ids", "*rope.freqs*", "freqs")
"""Tensors of files that are no weights: a tokenizer, positions, RoPE's angles."""


def to_jax(
    found: DetectedNetwork,
    config: ModelConfig,
    *,
    dtype: str | None = None,
    widening: Widening | None = None,
) -> list[Weight]:
    """Return the weights of a config's network, converted from a foreign checkpoint.

    With a `widening`, the checkpoint is a base model's. With a `dtype`, the layers of a stack may
    have several floating dtypes. Raises `WeightsError` listing all mismatches.
    """
    network = network_config(config, found.network)
    if widening is not None:
        network = replace(network, in_channels=widening.base.channels)
    leaves, tensors = _leaves(found, network, mixed=dtype is not None), found.tensors
    weights = {
        path: Weight(
            name=path,
            shape=leaf.shape,
            dtype=stored_as(leaf.dtype, dtype),
            pieces=tuple(partial(_to_jax, leaf.rule, tensors[name]) for name in leaf.names),
            names=tuple(f"{name} of {found.source.name}" for name in leaf.names),
        )
        for path, leaf in leaves.items()
    }
    if widening is not None:
        widening.apply(weights)
    return list(weights.values())


def to_torch(
    tensors: Mapping[str, Tensor],
    config: NetworkConfig,
    naming: str,
    *,
    dtype: str | None = None,
    source: str = "the weights",
) -> list[Weight]:
    """Return the foreign tensors of a naming, converted from the weights of a network.

    Raises `WeightsError` if the weights do not fit the network's config, and `InputError` if its
    table lacks the naming.
    """
    if problems := mismatches(tensors, weight_shapes(config)):
        raise WeightsError(problems, source=source)
    parts: dict[str, dict[int, _Part]] = {}
    for rule in table_of(config).rules(naming, config):
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
                shape=_fused([part.of(shape_only(part.tensor)) for part in group]).shape,
                dtype=stored_as(group[0].tensor.dtype, dtype),
                pieces=(lambda group=group: _fused([p.of(p.tensor.array()) for p in group]),),
            )
        )
    return weights


def merged(
    tensors: Mapping[str, Tensor],
    changes: Mapping[str, Change],
    config: NetworkConfig,
    *,
    scale: float,
) -> list[Weight]:
    """Return the weights of a denoiser with a LoRA merged into them; dtypes do not change.

    Raises `InputError` if the weights or the LoRA do not fit the network.
    """
    from egosim_jax.models import lora

    want = weight_shapes(config)
    if problems := mismatches(tensors, want):
        raise WeightsError(problems, source="dit.safetensors")
    lora.check_scale(scale)
    lora.check(want, changes)

    @np.errstate(over="ignore", invalid="ignore")
    def piece(path: str, layer: int | None) -> np.ndarray:
        at, name = (..., path) if layer is None else (layer, f"{path}, block {layer}")
        weight = tensors[path].array()[at]
        low_rank, full = changes.get(path.removesuffix(".kernel")), changes.get(path)
        added = []
        if path.endswith(".kernel") and isinstance(low_rank, lora.Delta):
            down, up = (array[at].astype(np.float32) for array in (low_rank.down, low_rank.up))
            added.append(down @ up)
        if isinstance(full, np.ndarray):
            added.append(full[at].astype(np.float32))
        elif isinstance(full, lora.Value):
            if scale == 1:  # exactly the value: adding a difference would round
                return full.array[at]
            added.append(full.array[at].astype(np.float32) - weight.astype(np.float32))
        if not added:
            return weight
        change = np.asarray(sum(added))
        result = weight.astype(np.float32) + scale * change
        if all_finite(result) or not all_finite(weight):
            return result
        why = "its alpha or its values are too high. Take another version of the LoRA."
        if all_finite(change):
            why = f"the scale {scale:g} is too high for it. Lower it. (--scale)"
        raise InputError(f"The LoRA makes values of {name} that float32 cannot hold: {why}")

    table = table_of(config)
    rules = table.rules(next(iter(table.namings)), config)
    stacked = {rule.target for rule in rules if rule.stacked}
    weights = []
    for path, tensor in tensors.items():
        layers = range(tensor.shape[0]) if path in stacked else (None,)
        pieces = tuple(partial(piece, path, layer) for layer in layers)
        weights.append(
            Weight(
                name=path,
                shape=tensor.shape,
                dtype=tensor.dtype,
                pieces=pieces,
                fix="Lower the scale, or merge into weights of bfloat16. (--scale, --merge)",
            )
        )
    return weights


def widening_of(config: ModelConfig, network: str, mode: WidenMode | None) -> Widening | None:
    """Return the widening of a model's denoiser from its base; None without a mode, or for others.

    Raises `InputError` without a narrower base.
    """
    if mode is None or network != "dit":
        return None
    table = table_of(config.dit)
    base = table.base
    if base is None:
        raise InputError(f"{config.name} has no base model to widen. (--widen)")
    missing = [part for part, _ in base.parts if part not in config.layout]
    if missing or base.channels >= config.layout.channels:
        raise InputError(
            f"{config.name} cannot be widened from a base model of {base.parts}: its layout "
            f"{config.layout.parts} must have all of these parts and more. (--widen, --only dit)"
        )
    if mode == "copy":
        base = replace(base, mask_one=config.layout.mask_one, mask_scale=config.layout.mask_scale)
    return Widening(base=base, layout=config.layout, input_layer=table.input_layer)


def fits(found: DetectedNetwork, config: ModelConfig) -> bool:
    """Return True if the checkpoint has exactly the weights of the config's network."""
    try:
        _leaves(found, network_config(config, found.network), mixed=True)
    except InputError:
        return False
    return True


def network_config(config: ModelConfig, network: str) -> Any:
    """Return the config of a model's network. Raises `InputError` for an unknown name."""
    networks = {str(name): found for name, found in config.networks.items()}
    if network not in networks:
        raise InputError(
            f"{config.name} has no network {network}; it has {', '.join(config.networks)}. "
            "(--config, --only)"
        )
    return networks[network]


@dataclass(frozen=True, kw_only=True)
class _Part:
    """Part of a foreign tensor that one rule contributes."""

    rule: Rule
    tensor: Tensor
    layer: int | None

    def of(self, weight: np.ndarray) -> np.ndarray:
        """Return the part of an array of the tensor's shape."""
        return self.rule.to_torch(weight if self.layer is None else weight[self.layer])


def _to_jax(rule: Rule, tensor: Tensor) -> np.ndarray:
    return rule.to_jax(tensor.array())


def _fused(arrays: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate(arrays) if len(arrays) > 1 else arrays[0]


def _leaves(found: DetectedNetwork, network: NetworkConfig, *, mixed: bool) -> dict[str, Leaf]:
    table = table_of(network)
    if table is not found.table:
        raise InputError(
            f"{found.source.name} holds another {found.network} network than {network.table} "
            "converts. (--config, --only)"
        )
    table.check(found.tensors)
    return assign(
        found.tensors,
        table.rules(found.naming, network),
        ignore=[*NO_WEIGHTS, *table.ignored(network)],
        want=weight_shapes(network),
        mixed=mixed,
        source=found.source.name,
    )
