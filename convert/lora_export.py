"""LoRA files to write: one that ComfyUI and diffusers load, or a folder in DWM's layout.

DWM's checkpoints have two files: the low-rank tensors, in the names of PEFT (CogVideoX) or
VideoX-Fun (Wan), and `non_lora_weights`, the full patch projection, which replaces the base's. The
network's table has the names of the first (`CheckpointNaming`).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from egosim_jax.convert.lora import IN_FULL
from egosim_jax.convert.lora_table import FULL, Location, locations_by_name
from egosim_jax.convert.tables import CheckpointNaming, table_of
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
    namings = table_of(config).namings.items()
    name, prefix = next(((n, to.lora_prefix) for n, to in namings if to.lora_prefix), ("", None))
    if prefix is None:
        raise InputError(f"{config.table} has no naming of LoRA files.")
    if values := [path for path, change in changes.items() if isinstance(change, Value)]:
        raise InputError(
            f"{listing(values)} replace weights of the base, which a LoRA file cannot: merge them "
            "into it. (--merge)"
        )
    naming = CheckpointNaming(naming=name, stem="", prefix=prefix, alpha=True)
    tensors, full = _named(changes, config, naming)
    suffixes = {kind: suffix for suffix, kind in FULL.items()}
    for key, (at, change) in full.items():
        layer, _, kind = key.rpartition(".")
        values = np.asarray(change)[... if at.layer is None else at.layer]
        if values.any():
            values = np.ascontiguousarray(at.rule.to_torch(values))
            tensors[f"{prefix}{layer}.{suffixes[kind]}"] = values
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
    naming = table_of(config).checkpoint
    if naming is None:
        raise InputError(
            f"{type(config).__name__} has no checkpoints in DWM's layout, only the models dwm_*: "
            "omit the layout. (--layout)"
        )
    low, full = _named(changes, config, naming)
    values = {}
    for key, (at, change) in full.items():
        if at.layer is not None:
            raise InputError(
                f"{at.target} was trained in full. These checkpoints have full weights only "
                "outside the blocks: merge the LoRA instead. (--merge)"
            )
        if isinstance(change, Value):
            value = change.array
        elif base is not None:
            value = base[at.target].array().astype(np.float32) + change
        else:
            raise InputError(
                f"{at.target} is a difference from the weights that the LoRA was trained on, and a "
                "checkpoint has values: give these weights. (--base)"
            )
        values[key] = np.ascontiguousarray(at.rule.to_torch(value))
    return {stem: tensors for stem, tensors in ((naming.stem, low), (IN_FULL, values)) if tensors}


def _named(
    changes: Mapping[str, Change], config: NetworkConfig, naming: CheckpointNaming
) -> tuple[dict[str, np.ndarray], dict[str, tuple[Location, Value | np.ndarray]]]:
    """Return low-rank tensors and full changes by their names. Raises `InputError` without one."""
    tensors, full, written = {}, {}, set()
    rules = table_of(config).rules(naming.naming, config)
    for key, at in locations_by_name(config, rules).items():
        delta, change = changes.get(at.path), changes.get(at.target)
        if isinstance(delta, Delta) and at.rule.transform == "linear":
            layer = ... if at.layer is None else at.layer
            tensors |= naming.tensors(key.rpartition(".")[0], delta.down[layer], delta.up[layer])
            written.add(at.path)
        if change is not None and not isinstance(change, Delta):
            full[key] = at, change
            written.add(at.target)
    if lost := sorted(changes.keys() - written):
        raise InputError(f"The layout has no names for {listing(lost)}: merge them. (--merge)")
    return tensors, full
