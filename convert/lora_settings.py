"""Settings of a LoRA: PEFT's `adapter_config.json`, diffusers' header entry, kohya's header.

A setting that changes the meaning of the tensors is applied or refused by its name. So is a setting
that is not known here: PEFT adds new ones.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egosim_jax.io.bounded import listing, parse_json, quote, quote_path, read_json
from egosim_jax.types import InputError

ADAPTER, ADAPTER_ENTRY = "adapter_config.json", "lora_adapter_metadata"
"""PEFT's settings: the file next to the weights, and diffusers' entry in a header."""
ADAPTER_STEM = "adapter_model"
"""Stem of the file that PEFT writes next to its settings."""
KEPT_BASE = (True, False, None, "gaussian", "orthogonal", "eva")
"""Values of `init_lora_weights` that do not change the base weights; all others do (PiSSA)."""
NEUTRAL = {
    "_custom_modules", "auto_mapping", "base_model_name_or_path", "corda_config",
    "ensure_weight_tying", "ephemeral_gpu_offload", "eva_config", "exclude_modules",
    "inference_mode", "layers_pattern", "layers_to_transform", "loftq_config", "lora_dropout",
    "lora_ga_config", "megatron_core", "peft_version", "qalora_group_size", "revision",
    "runtime_config", "task_type",
}  # fmt: skip
"""Keys of PEFT that say how a LoRA was trained, not what its tensors mean."""
APPLIED = {
    "alpha_pattern", "bias", "init_lora_weights", "lora_alpha", "modules_to_save", "peft_type", "r",
    "rank_pattern", "target_modules", "use_rslora",
}  # fmt: skip
"""Keys of PEFT that are read."""
MERGE = (
    "Merge the adapter into its base in the project that trained it (PEFT: merge_and_unload), and "
    "convert the merged weights. (egosim convert weights)"
)
"""Fix of what this package cannot apply."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of all layers of a LoRA."""

    source: str = ""
    """File or header entry, for error messages."""
    alpha: float | None = None
    """Alpha of layers without one; None: the rank."""
    rank_stabilized: bool = False
    """True for a scale of alpha / sqrt(r), as in rsLoRA, instead of alpha / r."""
    ranks: frozenset[int] = frozenset()
    """Ranks that layers may have; empty if not said."""
    targets: tuple[str, ...] = ()
    """Ends of the names of the adapted layers; empty if not said as names."""
    saved: tuple[str, ...] = ()
    """Ends of the names of layers whose weights are in the file in full."""

    def scale(self, alpha: float | None, rank: int) -> float:
        """Return the factor of a low-rank product."""
        alpha = self.alpha if alpha is None else alpha
        if alpha is None:
            return 1.0
        return alpha / (math.sqrt(rank) if self.rank_stabilized else rank)

    def misfit(self, layer: str, rank: int, alpha: float | None) -> str | None:
        """Return why a layer is not of the adapter with these settings, or None.

        `layer` is its name in the file, `alpha` the file's own.
        """
        if self.ranks and rank not in self.ranks:
            return f"{layer} has rank {rank}; expected {listing(sorted(map(str, self.ranks)))}"
        if self.targets and not _ends(layer, self.targets):
            return f"{layer} is not of its target_modules, {listing(self.targets)}"
        if None not in (alpha, self.alpha) and alpha != self.alpha and self.source:
            return f"{layer} has alpha {alpha:g}; expected lora_alpha {self.alpha:g}"
        return None

    def saves(self, layer: str) -> bool:
        """Return True if the settings say that a layer's weights are in the file in full."""
        return _ends(layer, self.saved)


def _ends(layer: str, ends: tuple[str, ...]) -> bool:
    plain = layer.replace(".", "_")
    tails = [end.replace(".", "_") for end in ends]
    return any(plain == tail or plain.endswith(f"_{tail}") for tail in tails)


def settings_of(path: Path, file: Path, metadata: Mapping[str, str]) -> Settings:
    """Read the settings of a LoRA file from the adapter's config next to it, or from its header.

    `path` is the file or its folder. Raises `InputError` naming a setting that cannot be applied.
    """
    adapter = (path if path.is_dir() else path.parent) / ADAPTER
    if os.path.lexists(adapter):
        others = [f for f in adapter.parent.glob(f"{ADAPTER_STEM}.*") if f.is_file()]
        if file.stem != ADAPTER_STEM and others:
            raise InputError(
                f"{quote_path(adapter)} belongs to {quote_path(others[0].name)}, not to "
                f"{quote_path(file.name)}: move one of the two LoRAs to another folder."
            )
        return _peft(read_json(adapter), source=quote_path(adapter))
    if ADAPTER_ENTRY in metadata:
        source = f"{ADAPTER_ENTRY} of {quote_path(path)}"
        adapted = parse_json(metadata[ADAPTER_ENTRY].encode(), source=source)
        if isinstance(adapted, dict):  # of a pipeline: each key has its network before it
            own = {k.removeprefix("transformer."): v for k, v in adapted.items() if "." in k}
            adapted = {k: v for k, v in own.items() if "." not in k} or adapted
        return _peft(adapted, source=source)
    alpha = metadata.get("alpha", metadata.get("ss_network_alpha", "None"))
    if alpha in ("None", ""):
        return Settings()
    return Settings(alpha=finite(alpha, f"The alpha of {quote_path(path)}"))


def _peft(adapter: Any, *, source: str) -> Settings:
    match adapter:
        case {"lora_alpha": alpha}:
            pass
        case _:
            raise InputError(f"{source} has no lora_alpha, which PEFT writes. Add it.")
    _refuse_others(adapter, source)
    ranks = _numbers(adapter, "rank_pattern", source)
    if (rank := adapter.get("r")) is not None:
        ranks |= {finite(rank, f"r of {source}")}
    alpha = finite(alpha, f"lora_alpha of {source}")
    if _numbers(adapter, "alpha_pattern", source) - {alpha}:
        raise InputError(
            f"{source} has an alpha_pattern, and here all layers have one lora_alpha. {MERGE}"
        )
    return Settings(
        source=source,
        alpha=alpha,
        rank_stabilized=adapter.get("use_rslora") is True,
        ranks=frozenset(int(rank) for rank in ranks)
        if adapter.get("r") is not None
        else frozenset(),
        targets=_names(adapter, "target_modules"),
        saved=_names(adapter, "modules_to_save"),
    )


def _refuse_others(adapter: Mapping[str, Any], source: str) -> None:
    """Raise `InputError` naming a setting that changes the meaning and cannot be applied."""
    kind = adapter.get("peft_type", "LORA")
    if kind != "LORA":
        raise InputError(f"{source} has peft_type {quote(kind)}, which is not a LoRA. {MERGE}")
    start = adapter.get("init_lora_weights")
    if not any(start is value or start == value for value in KEPT_BASE):
        raise InputError(
            f"{source} has init_lora_weights {quote(start)}, which also changes the base weights: "
            "on the original base, this adapter would mean something else. Save it in PEFT as a "
            "plain LoRA (save_pretrained with path_initial_model_for_weight_conversion), or: "
            f"{MERGE}"
        )
    bias = adapter.get("bias")
    if bias not in (None, "none"):
        raise InputError(f"{source} has bias {quote(bias)}: trained biases are not read. {MERGE}")
    empty = (None, False, "", 0, [], {})
    for key in sorted(adapter.keys() - NEUTRAL - APPLIED, key=str):
        if not any(adapter[key] == value for value in empty):
            raise InputError(
                f"{source} has {quote(key)} {quote(adapter[key])}, which may change what the "
                f"adapter means and cannot be applied. {MERGE}"
            )
    if adapter.get("use_rslora") not in (None, False, True):
        raise InputError(f"{source} has use_rslora {quote(adapter['use_rslora'])}, not a boolean.")


def _numbers(adapter: Mapping[str, Any], key: str, source: str) -> set[float]:
    """Return the values of a pattern."""
    pattern = adapter.get(key) or {}
    if not isinstance(pattern, dict):
        raise InputError(f"{source} has {key} {quote(pattern)}, which is not a JSON object.")
    return {finite(value, f"{key} of {source}") for value in pattern.values()}


def _names(adapter: Mapping[str, Any], key: str) -> tuple[str, ...]:
    """Return a list of names; empty for a pattern in one text, which is not evaluated."""
    names = adapter.get(key)
    return tuple(n for n in names if isinstance(n, str)) if isinstance(names, list) else ()


def finite(value: Any, name: str) -> float:
    """Return a value as a finite number. Raises `InputError` if it is not one."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{name} is {quote(value)}, which is not a finite number.")
    return number
