"""LoRA files to write: one that ComfyUI and diffusers load, or a folder in DWM's layout.

DWM's checkpoints have two files: the low-rank tensors, in the names of PEFT (CogVideoX) or
VideoX-Fun (Wan), and `non_lora_weights`, the full patch projection, which replaces the base's. The
network's table has the names of the first (`CheckpointNaming`).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from egosim_jax.convert.lora import IN_FULL
from egosim_jax.convert.lora_names import FULL, locations_by_name
from egosim_jax.convert.tables import CheckpointNaming, Table, table_of
from egosim_jax.io.bounded import listing
from egosim_jax.io.mapped import Tensor
from egosim_jax.models import NetworkConfig
from egosim_jax.models.lora import Change, Delta, Value
from egosim_jax.types import InputError

Files = dict[str, dict[str, np.ndarray]]
"""Tensors by file stem."""


def exported(changes: Mapping[str, Change], config: NetworkConfig) -> dict[str, np.ndarray]:
    """Return the tensors of a LoRA file; alpha is the rank, because `up` includes the scale.

    Raises `InputError` if no naming of the network's table is for LoRA files.
    """
    namings = table_of(config).namings.values()
    naming = next((naming for naming in namings if naming.lora_prefix is not None), None)
    if naming is None:
        raise InputError(f"{config.table} has no naming of LoRA files.")
    if values := [path for path, change in changes.items() if isinstance(change, Value)]:
        raise InputError(
            f"{listing(values)} replace weights of the base, which a LoRA file cannot: merge them "
            "into it. (--merge)"
        )
    tensors, prefix = {}, naming.lora_prefix
    suffixes = {kind: suffix for suffix, kind in FULL.items()}
    known = locations_by_name(config, naming.rules(config))
    for key, location in known.items():
        name, _, kind = key.rpartition(".")
        layer = ... if location.layer is None else location.layer
        delta, full = changes.get(location.path), changes.get(location.target)
        if isinstance(delta, Delta) and location.rule.transform == "linear":
            down, up = delta.down[layer], delta.up[layer]
            tensors[f"{prefix}{name}.lora_A.weight"] = np.ascontiguousarray(down.T)
            tensors[f"{prefix}{name}.lora_B.weight"] = np.ascontiguousarray(up.T)
            tensors[f"{prefix}{name}.alpha"] = np.array(down.shape[-1], np.float32)
        if isinstance(full, np.ndarray) and full[layer].any():
            values = location.rule.to_torch(full[layer])
            tensors[f"{prefix}{name}.{suffixes[kind]}"] = np.ascontiguousarray(values)
    return tensors


def exported_metadata(changes: Mapping[str, Change]) -> dict[str, str]:
    """Return the header metadata of a LoRA file."""
    ranks = {change.down.shape[-1] for change in changes.values() if isinstance(change, Delta)}
    rank = str(max(ranks, default=0))
    return {"format": "pt"} | ({"rank": rank, "alpha": rank} if ranks else {})


def checkpoint(
    changes: Mapping[str, Change], config: NetworkConfig, base: Mapping[str, Tensor] | None
) -> Files:
    """Return the tensors of each file of a checkpoint in DWM's layout.

    A weight that is stored as a difference needs the weights of its base. Raises `InputError` for a
    network without such checkpoints, full weights in the blocks, or a missing base.
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
                    f"{at.target} was trained in full. These checkpoints have full weights only "
                    "outside the blocks: merge the LoRA instead. (--merge)"
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
    """Return a full weight: a given value, or the base's value plus the difference."""
    if isinstance(change, Value):
        return change.array
    if base is None:
        raise InputError(
            f"{target} is a difference from the weights that the LoRA was trained on, and a "
            "checkpoint has values: give these weights. (--base)"
        )
    return base[target].array().astype(np.float32) + change
