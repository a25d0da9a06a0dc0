"""Reading of LoRA files in every common naming.

Our own code, because each library reads its own naming alone, and only into PyTorch modules.

A tensor's name has a prefix (`diffusion_model.`, `transformer.`, `base_model.model.`,
`lora_unet_`), a layer of the denoiser in one of its table's namings, with dots or, in kohya's
files, underscores, and the role of the tensor: `lora_A` or `lora_down`, `lora_B` or `lora_up`,
`alpha`, or a full difference of a weight, bias or modulation: `diff`, `diff_b`, `diff_m`. The
default alpha is in PEFT's `adapter_config.json` or in the file's header, else it is the rank.

A folder can also have full weights in a file `non_lora_weights`, like DWM's, whose patch projection
replaces the base's. `lora_export` writes LoRA files.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import ml_dtypes
import numpy as np
from einops import EinopsError

from egosim_jax.convert.rules import Rule, shape_only
from egosim_jax.convert.source import PTH, Source, sources
from egosim_jax.convert.tables import table_of, weight_shapes
from egosim_jax.io.bounded import listing, parse_json, quote, quote_path, quote_text, read_json
from egosim_jax.io.mapped import OURS, RefusedError, Tensor, read_metadata
from egosim_jax.models.lora import (
    BASE,
    MAX_RANK,
    Change,
    Delta,
    Value,
    check,
    from_tensors,
    misfit,
    pairs,
    refuse,
)
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.models import NetworkConfig

PREFIXES = (
    "base_model.model.", "diffusion_model.", "model.", "transformer.", "pipe.dit.", "dit.",
    "lora_unet_", "lora_transformer_", "_",
)  # fmt: skip
"""Prefixes of layer names in LoRA files of other projects, in any naming."""
TEXT_PREFIXES = ("lora_te", "text_encoder.", "text_encoders.")
"""Prefixes of a text encoder's layers, which are skipped."""
LOW_RANK = {
    "lora_A": "down", "lora_down": "down", "lora_B": "up", "lora_up": "up", "alpha": "alpha",
}  # fmt: skip
"""Role of a low-rank tensor by the suffix of its name."""
FULL = {"diff": "weight", "diff_b": "bias", "diff_m": "modulation"}
"""Kind of weight of a full difference by the suffix of its name."""
IN_FULL = "non_lora_weights"
"""Stem of the file next to a LoRA whose weights replace the base's."""
ENDS = (".safetensors", *PTH)
"""Extensions of weight files."""
ADAPTER, ADAPTER_ENTRY = "adapter_config.json", "lora_adapter_metadata"
"""PEFT's settings: the file next to the weights, and diffusers' entry in a header."""
HALF = (np.dtype(np.float16), np.dtype(ml_dtypes.bfloat16))
"""Dtypes that a LoRA keeps; all others are read as float32."""
SUFFIX = re.compile(rf"\.({'|'.join((*LOW_RANK, *FULL))})(\.default)?(\.weight)?$")


@dataclass(frozen=True)
class Location:
    """A weight, or one layer of a stacked weight."""

    target: str
    """Path of the weight."""
    layer: int | None
    """Index of the block; None for a weight that is not stacked."""
    rule: Rule = field(compare=False)
    """Conversion rule of the naming that matched."""

    @property
    def path(self) -> str:
        """Path of the layer if the weight is a kernel, else of the weight."""
        return self.target.removesuffix(".kernel")

    def __str__(self) -> str:
        return self.path if self.layer is None else f"{self.path}, block {self.layer}"


def read_lora(path: Path, config: NetworkConfig) -> dict[str, Change]:
    """Return the changes of a LoRA by path; files in our format have the same paths.

    `path` is a file, or its folder with PEFT's config or full weights. Missing blocks are 0; lower
    ranks in a stack are padded with 0 to the highest. Half-precision tensors keep their dtype if
    nothing is computed; all others are float32. Layers of a text encoder are skipped with a
    message. Raises `InputError` listing every tensor that is not of the network or does not fit,
    and every value that is not finite.
    """
    source, in_full = _found(path)
    want = weight_shapes(config)
    metadata = metadata_of(source.files[0])
    if metadata.get("format") == OURS:
        found = pairs(source.tensors)
        whys = {at: misfit(want, at, down.shape, up.shape) for at, (down, up) in found.items()}
        refuse([f"{at}: {why}" for at, why in whys.items() if why])
        arrays = {name: tensor.array() for name, tensor in source.tensors.items()}
        changes: dict[str, Change] = {**from_tensors(arrays)}
    else:
        with np.errstate(over="ignore", invalid="ignore"):  # `check` refuses values not finite
            changes = _translated(source, config, want, settings_of(path, metadata))
    if in_full is not None:
        changes |= _values(in_full, config, want)
    if not changes:
        raise InputError(f"{quote_path(path)} has no layers of this network.")
    check(want, changes)
    return changes


def metadata_of(file: Path) -> dict[str, str]:
    """Return the text metadata of a file; empty for formats without."""
    return read_metadata(file) if file.suffix == ".safetensors" else {}


def check_base(path: Path, known: Collection[str]) -> None:
    """Raise `InputError` if a LoRA's header names base weights of another hash."""
    base = base_of(path)
    if base is not None and base not in known:
        raise InputError(
            f"{quote_path(path)} was trained on other weights: their {BASE} is "
            f"{quote_text(base[:12])}…, not {', '.join(f'{name[:12]}…' for name in known)}. Use "
            "the weights that it was trained on, or merge it into others with `egosim convert lora "
            "--merge OTHERS --base ITS_WEIGHTS`."
        )


def base_of(path: Path) -> str | None:
    """Return the hash of the base weights in the header of a LoRA file or folder, or None."""
    return metadata_of(_found(path)[0].files[0]).get(BASE)


def _found(path: Path) -> tuple[Source, Source | None]:
    """Return the LoRA of a file or folder, and the full weights next to it, if any.

    Raises `InputError` for a file that is only a part of such a folder.
    """
    parts = [] if path.is_dir() else [path.with_name(f"{IN_FULL}{end}") for end in ENDS]
    if part := next(filter(Path.exists, parts), None):
        raise InputError(
            f"{quote_path(path)} is only a part of a LoRA: the full weights next to it, "
            f"{part.name}, must be read with it. Give the folder that holds these two files, "
            f"{quote_path(path.parent)}."
        )
    found = list(sources(path))
    in_full = [source for source in found if source.files[0].stem == IN_FULL]
    low_rank = [source for source in found if source not in in_full]
    if len(low_rank) != 1 or len(in_full) > 1:
        raise InputError(
            f"{quote_path(path)} holds {len(found)} weight files; expected one, and at most one "
            f"{IN_FULL}."
        )
    return low_rank[0], in_full[0] if in_full else None


def _values(
    source: Source, config: NetworkConfig, want: Mapping[str, tuple[int, ...]]
) -> dict[str, Change]:
    """Return the full weights of a file by path."""
    known = _locations(config, PREFIXES)
    changes: dict[str, Change] = {}
    problems = []
    for key, tensor in source.tensors.items():
        location = known.get(_plain(key, PREFIXES))
        if location is None or location.layer is not None:
            problems.append(f"{key}: not a weight of this network outside its blocks")
            continue
        try:
            array = location.rule.to_jax(tensor.array()).astype(_dtype([tensor]))
        except (EinopsError, ValueError):
            problems.append(f"{key}: has shape {tensor.shape}; expected {want[location.target]}")
            continue
        changes[location.target] = Value(array=array)
    if problems:
        raise InputError(f"{source.name} does not fit this network: {listing(problems)}.")
    return changes


def _translated(
    source: Source,
    config: NetworkConfig,
    want: Mapping[str, tuple[int, ...]],
    settings: Settings,
) -> dict[str, Change]:
    """Convert a file in a foreign naming; check all shapes before reading values."""
    namings = table_of(config).namings.values()
    prefixes = (*PREFIXES, *(naming.lora_prefix for naming in namings if naming.lora_prefix))
    known = _locations(config, prefixes)
    low_rank: dict[Location, dict[str, Tensor]] = {}
    full: dict[Location, Tensor] = {}
    problems, text = [], 0
    for key, tensor in source.tensors.items():
        if key.startswith(TEXT_PREFIXES):
            text += 1
            continue
        suffix = SUFFIX.search(key)
        kind = suffix[1] if suffix else ""
        layer = _plain(key[: suffix.start()], prefixes) if suffix else ""
        location = known.get(f"{layer}_{FULL.get(kind, 'weight')}")
        if location is None or (kind in LOW_RANK and location.rule.transform != "linear"):
            problems.append(f"{key}: not of a layer of this network")
        elif (kind in FULL and location in full) or LOW_RANK.get(kind) in low_rank.get(
            location, {}
        ):
            problems.append(f"{key}: duplicate of another name")
        elif kind in LOW_RANK:
            low_rank.setdefault(location, {})[LOW_RANK[kind]] = tensor
        else:
            full[location] = tensor
    if text:
        print(
            printable(f"{source.name}: skipped {text} tensors of a text encoder"), file=sys.stderr
        )
    pairs = {}
    for location, found in low_rank.items():
        try:
            kernel = want[f"{location.path}.kernel"][-2:]
            pairs[location] = _pair(location, found, kernel, settings)
        except RefusedError as error:
            problems.append(f"{location}: {error}")
    for location, tensor in full.items():
        shape = want[location.target][location.layer is not None :]
        try:
            have = location.rule.to_jax(shape_only(tensor)).shape
        except (EinopsError, ValueError):
            have = tensor.shape
        if have != shape:
            problems.append(f"{location}: has shape {have}; expected {shape}")
    if problems:
        raise InputError(
            f"{len(problems)} tensors of {source.name} are not of a LoRA of this network: "
            f"{listing(problems)}."
        )
    changes: dict[str, Change] = {}
    for path in dict.fromkeys(location.path for location in pairs):
        shape = want[f"{path}.kernel"]
        changes[path] = _stacked({p.layer: v for p, v in pairs.items() if p.path == path}, shape)
    for target in dict.fromkeys(location.target for location in full):
        here = [location for location in full if location.target == target]
        values = np.zeros(want[target], _dtype([full[location] for location in here]))
        for location in here:
            layer = ... if location.layer is None else location.layer
            values[layer] = location.rule.to_jax(full[location].array())
        changes[target] = values
    return changes


class Pair(NamedTuple):
    """Low-rank tensors of a layer, not yet read, and the factor of their product."""

    down: Tensor
    """Down projection `[r, in]`."""
    up: Tensor
    """Up projection `[out, r]`."""
    scale: float


def _pair(
    location: Location, found: Mapping[str, Tensor], kernel: tuple[int, ...], settings: Settings
) -> Pair:
    """Return the low-rank tensors of a layer. Raises `RefusedError` unless they fit its kernel."""
    for role, name in (("down", "lora_A"), ("up", "lora_B")):
        if role not in found:
            raise RefusedError(f"has no {name}")
    down, up = found["down"], found["up"]
    rank = down.shape[0] if down.shape else 0
    if not 1 <= rank <= MAX_RANK:
        raise RefusedError(f"has rank {rank}; expected 1 to {MAX_RANK}")
    wide, out = kernel
    if (down.shape, up.shape) != ((rank, wide), (out, rank)):
        raise RefusedError(
            f"has shapes {down.shape} and {up.shape}; expected {(rank, wide)} and {(out, rank)}"
        )
    alpha = None
    if (scalar := found.get("alpha")) is not None:
        if math.prod(scalar.shape) != 1:
            raise RefusedError(f"has {math.prod(scalar.shape)} numbers as alpha; expected one")
        alpha = finite(float(scalar.array().item()), f"The alpha of {location}")
    return Pair(down, up, settings.scale(alpha, rank))


def _stacked(layers: Mapping[int | None, Pair], kernel: tuple[int, ...]) -> Delta:
    """Stack the low-rank tensors of all layers; `up` includes the scale."""
    pairs = layers.values()
    rank = max(pair.down.shape[0] for pair in pairs)
    *stacked, wide, out = kernel
    down = np.zeros((*stacked, wide, rank), _dtype([pair.down for pair in pairs]))
    same = all(pair.scale == 1 for pair in pairs)
    up_dtype = _dtype([pair.up for pair in pairs]) if same else np.float32
    up = np.zeros((*stacked, rank, out), up_dtype)
    for number, pair in layers.items():
        here, at = pair.down.shape[0], ... if number is None else number
        down[at][:, :here] = pair.down.array().T
        up[at][:here] = pair.scale * pair.up.array().astype(np.float32).T
    return Delta(down=down, up=up)


def _dtype(tensors: Sequence[Tensor]) -> np.dtype:
    """Return the half-precision dtype of all tensors if they share one, else float32."""
    dtypes = {tensor.dtype for tensor in tensors}
    shared = next(iter(dtypes))
    return shared if len(dtypes) == 1 and shared in HALF else np.dtype(np.float32)


def _locations(config: NetworkConfig, prefixes: Sequence[str]) -> dict[str, Location]:
    """Return the weights by their plain names in all namings; earlier namings take precedence."""
    known: dict[str, Location] = {}
    for naming in table_of(config).namings.values():
        named = locations_by_name(config, naming.rules(config))
        known = {_plain(name, prefixes): location for name, location in named.items()} | known
    return known


def locations_by_name(config: NetworkConfig, rules: Sequence[Rule]) -> dict[str, Location]:
    """Return the weights of a network by their names in a naming."""
    want = weight_shapes(config)
    return {
        rule.source.replace("*", str(layer)): Location(rule.target, layer, rule)
        for rule in rules
        for layer in (range(want[rule.target][0]) if rule.stacked else (None,))
    }


def _plain(name: str, prefixes: Sequence[str]) -> str:
    """Return a layer's name without prefixes and with underscores for dots."""
    while prefix := next((p for p in prefixes if name.startswith(p)), None):
        name = name.removeprefix(prefix)
    return name.replace(".", "_")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of all layers of a LoRA."""

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


def finite(value: Any, name: str) -> float:
    """Return a value as a finite number. Raises `InputError` if it is not one."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{name} is {quote(value)}, which is not a finite number.")
    return number
