"""Settings of a LoRA in PEFT's and in other headers: alpha, and the scale that it gives."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egosim_jax.io.bounded import parse_json, quote, quote_path, read_json
from egosim_jax.types import InputError

ADAPTER, ADAPTER_ENTRY = "adapter_config.json", "lora_adapter_metadata"
"""Settings of PEFT: file next to the weights, and diffusers' entry in a header."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of a LoRA that hold for all its layers."""

    alpha: float | None = None
    """Alpha of layers without one; None: the rank."""
    rank_stabilized: bool = False
    """True for a scale of alpha / sqrt(r), as in rsLoRA, instead of alpha / r."""

    def scale(self, alpha: float | None, rank: int) -> float:
        """Return the factor of a low-rank product."""
        alpha = self.alpha if alpha is None else alpha
        if alpha is None:
            return 1.0
        return alpha / (math.sqrt(rank) if self.rank_stabilized else rank)


def settings_of(path: Path, metadata: Mapping[str, str]) -> Settings:
    """Read the settings from the adapter's config or from the header."""
    adapter = (path if path.is_dir() else path.parent) / ADAPTER
    if os.path.lexists(adapter):
        return _peft(read_json(adapter), source=quote_path(adapter))
    if ADAPTER_ENTRY in metadata:
        source = f"{ADAPTER_ENTRY} of {quote_path(path)}"
        adapted = parse_json(metadata[ADAPTER_ENTRY].encode(), source=source)
        return _peft(
            {name.removeprefix("transformer."): value for name, value in adapted.items()}
            if isinstance(adapted, dict)
            else adapted,
            source=source,
        )
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
    if adapter.get("alpha_pattern"):
        raise InputError(
            f"{source} has an alpha_pattern, which is not supported: set one lora_alpha."
        )
    return Settings(
        alpha=finite(alpha, f"lora_alpha of {source}"),
        rank_stabilized=adapter.get("use_rslora") is True,
    )


def finite(value: Any, what: str) -> float:
    """Return a finite number. Raises `InputError` for everything else."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{what} is {quote(value)}, which is not a finite number.")
    return number
