"""Write a LoRA with the weights that were trained in full in the layout of DWM's checkpoints.

A checkpoint has two files: the low-rank tensors, in the names of PEFT (CogVideoX) or of VideoX-Fun
(Wan), and `non_lora_weights`, the patch projection in full, which replaces that of the base. How
the first is named is a part of the network's table (`CheckpointNaming`).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from egosim_jax.convert.lora import IN_FULL, locations_by_name
from egosim_jax.convert.tables import CheckpointNaming, Table, table_of
from egosim_jax.io.bounded import listing
from egosim_jax.io.mapped import Tensor
from egosim_jax.models import NetworkConfig
from egosim_jax.models.lora import Change, Delta, Value
from egosim_jax.types import InputError

Files = dict[str, dict[str, np.ndarray]]
"""Tensors by file stem."""


def checkpoint(
    changes: Mapping[str, Change], config: NetworkConfig, base: Mapping[str, Tensor] | None
) -> Files:
    """Return the tensors of a checkpoint's files.

    Weights that a training changed, and not a checkpoint replaced, need those of its base. Raises
    `InputError` for a network without such checkpoints, weights in the blocks, or a missing base.
    """
    table = table_of(config)
    naming = _naming(table, config)
    files: Files = {naming.stem: {}, IN_FULL: {}}
    written = set()
    for key, at in locations_by_name(config, table.rules(naming.naming, config)).items():
        name, _, kind = key.rpartition(".")
        layer = ... if at.layer is None else at.layer
        delta, full = changes.get(at.path), changes.get(at.target)
        if isinstance(delta, Delta) and at.rule.transform == "linear" and kind == "weight":
            files[naming.stem] |= naming.tensors(name, delta.down[layer], delta.up[layer])
            written.add(at.path)
        if full is not None and not isinstance(full, Delta):
            if at.layer is not None:
                raise InputError(
                    f"{at.target} was trained in full, which these checkpoints have only outside "
                    "the blocks: merge the LoRA instead. (--merge)"
                )
            value = _value(at.target, full, base)
            files[IN_FULL][key] = np.ascontiguousarray(at.rule.to_torch(value))
            written.add(at.target)
    if lost := sorted(changes.keys() - written):
        raise InputError(f"The checkpoint has no names for {listing(lost)}: merge them. (--merge)")
    return {stem: tensors for stem, tensors in files.items() if tensors}


def _naming(table: Table, config: NetworkConfig) -> CheckpointNaming:
    if table.checkpoint is None:
        raise InputError(
            f"{type(config).__name__} has no checkpoints in DWM's layout, only the models dwm_*: "
            "omit the layout. (--layout)"
        )
    return table.checkpoint


def _value(
    target: str, change: Value | np.ndarray, base: Mapping[str, Tensor] | None
) -> np.ndarray:
    """Return a weight in full: as it was given, or that of the base with its difference."""
    if isinstance(change, Value):
        return change.array
    if base is None:
        raise InputError(
            f"{target} is a difference from the weights that the LoRA was trained on, and a "
            "checkpoint has values: give those weights. (--base)"
        )
    return base[target].array().astype(np.float32) + change
