"""Reading of LoRA files in the names and with the settings of `lora_table`.

Our own code, because each library reads its own naming alone, and only into PyTorch modules.

A tensor is a low-rank factor, its alpha, or a full difference of a weight, bias or modulation. A
low-rank change of a convolution is multiplied out. Alpha is the rank if nothing says it.

A folder can also have full weights in a file `non_lora_weights`, like DWM's, whose patch projection
replaces the base's. `lora_export` writes LoRA files.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import ml_dtypes
import numpy as np
from einops import EinopsError

from egosim_jax.convert.detect import BASE_LAYER
from egosim_jax.convert.finite import all_finite
from egosim_jax.convert.lora_table import (
    MERGE,
    SUFFIX,
    TEXT,
    Location,
    Name,
    Settings,
    chosen,
    locations,
    parse,
    refuse_others,
    said,
    settings_of,
)
from egosim_jax.convert.source import Source, sources
from egosim_jax.convert.tables import weight_shapes
from egosim_jax.io.bounded import listing, quote, quote_path, quote_text
from egosim_jax.io.mapped import OURS, RefusedError, Tensor, read_metadata
from egosim_jax.io.untrusted.pth import SUFFIXES
from egosim_jax.models.lora import (
    BASE,
    MAX_RANK,
    Change,
    Delta,
    Value,
    check,
    from_tensors,
    refuse,
)
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.models import NetworkConfig

IN_FULL = "non_lora_weights"
"""Stem of the file next to a LoRA whose weights replace the base's."""
HALF = (np.dtype(np.float16), np.dtype(ml_dtypes.bfloat16))
"""Dtypes that a LoRA keeps; all others are read as float32."""
Shapes = Mapping[str, tuple[int, ...]]


def read_lora(
    path: Path, config: NetworkConfig, *, prefix: str | None = None, adapter: str | None = None
) -> dict[str, Change]:
    """Return the changes of a LoRA by path; files in our format have the same paths.

    `path` is a file, or its folder with PEFT's config or full weights. Of several LoRAs in a file,
    `prefix` or `adapter` chooses one. Missing blocks are 0; lower ranks in a stack are padded with
    0 to the highest. Half-precision tensors keep their dtype if nothing is computed; all others are
    float32. Layers of a text encoder are skipped with a message. Raises `InputError` listing every
    tensor that is not of the network or does not fit, every value that is not finite, and a setting
    that cannot be applied.
    """
    source, in_full = _files(path)
    want, by_name = weight_shapes(config), locations(config)
    metadata = metadata_of(source.files[0])
    if metadata.get("format") == OURS:
        arrays = {name: tensor.array() for name, tensor in source.tensors.items()}
        changes: dict[str, Change] = {**from_tensors(arrays)}
    else:
        settings = settings_of(path, source.files[0], metadata)
        names, problems = _names(source, by_name, settings, prefix=prefix, adapter=adapter)
        if settings.saved and in_full is None and all(name.role != "value" for name in names):
            raise InputError(
                f"{settings.source} has modules_to_save {listing(settings.saved)}, but "
                f"{source.name} has no weights of them. {MERGE}"
            )
        with np.errstate(over="ignore", invalid="ignore"):  # `check` refuses values not finite
            changes = _translated(source, names, problems, want, settings)
    if in_full is not None:
        changes |= _values(in_full, {key: parse(key, by_name) for key in in_full.tensors}, want)
    if not changes:
        raise InputError(f"{quote_path(path)} has no layers of this network.")
    check(want, changes)
    return changes


def metadata_of(file: Path) -> dict[str, str]:
    """Return the text metadata of a file; empty for formats without."""
    return read_metadata(file) if file.suffix == ".safetensors" else {}


def check_base(path: Path, hashes: Collection[str]) -> None:
    """Raise `InputError` if a LoRA's header names base weights of another hash."""
    base = base_of(path)
    if base is not None and base not in hashes:
        raise InputError(
            f"{quote_path(path)} was trained on other weights: their {BASE} is "
            f"{quote_text(base[:12])}…, not {', '.join(f'{name[:12]}…' for name in hashes)}. Use "
            "the weights that it was trained on, or merge it into others with `egosim convert lora "
            "--merge OTHERS --base ITS_WEIGHTS`."
        )


def base_of(path: Path) -> str | None:
    """Return the hash of the base weights in the header of a LoRA file or folder, or None."""
    return metadata_of(_files(path)[0].files[0]).get(BASE)


def _files(path: Path) -> tuple[Source, Source | None]:
    """Return the LoRA of a file or folder, and the full weights next to it, if any.

    Raises `InputError` for one file of a folder with full weights.
    """
    ends = () if path.is_dir() else (".safetensors", *SUFFIXES)
    near = (path.with_name(f"{IN_FULL}{end}") for end in ends)
    if full := next(filter(Path.exists, near), None):
        raise InputError(
            f"{quote_path(path)} is only a part of a LoRA: the full weights next to it, "
            f"{full.name}, must be read with it. Give the folder that holds these two files, "
            f"{quote_path(path.parent)}."
        )
    files = list(sources(path))
    in_full = [source for source in files if source.files[0].stem == IN_FULL]
    low_rank = [source for source in files if source not in in_full]
    if len(low_rank) != 1 or len(in_full) > 1:
        raise InputError(
            f"{quote_path(path)} holds {len(files)} weight files; expected one, and at most one "
            f"{IN_FULL}."
        )
    return low_rank[0], in_full[0] if in_full else None


def _values(source: Source, names: Mapping[str, Name | None], want: Shapes) -> dict[str, Change]:
    """Return the full weights of a file by path."""
    changes: dict[str, Change] = {}
    problems = []
    for key, name in names.items():
        if name is None or name.role != "value" or name.location.layer is not None:
            problems.append(f"{key}: not a weight of this network outside its blocks")
            continue
        location, tensor = name.location, source.tensors[key]
        try:
            array = location.rule.to_jax(tensor.array()).astype(_dtype([tensor]))
        except (EinopsError, ValueError):
            problems.append(f"{key}: has shape {tensor.shape}; expected {want[location.target]}")
            continue
        changes[location.target] = Value(array=array)
    if problems:
        raise InputError(f"{source.name} does not fit this network: {listing(problems)}.")
    return changes


def _names(
    source: Source,
    by_name: Mapping[str, Location],
    settings: Settings,
    *,
    prefix: str | None,
    adapter: str | None,
) -> tuple[list[Name], list[str]]:
    """Return the names of the tensors of one LoRA, and why others cannot be of it.

    As in `egosim convert weights`, tensors outside the prefix of the network are skipped, with a
    message. So is the base of a checkpoint that was saved with its LoRA.
    """
    keys = [key for key in source.tensors if not TEXT.search(key)]
    if text := len(source.tensors) - len(keys):
        _say(source, f"skipped {text} tensors of a text encoder")
    refuse_others(keys, source=source.name)
    parsed = (parse(key, by_name) for key in keys)
    inner = [n for n in parsed if n and (n.role != "value" or settings.saves(n.layer))]
    names = chosen(inner, source=source.name, prefix=prefix, adapter=adapter)
    prefixes = tuple({name.prefix for name in names} or {""})
    with_base = any(BASE_LAYER in key for key in keys)
    skipped, problems = {name.key for name in inner} - {name.key for name in names}, []
    for key in {*keys} - {name.key for name in inner}:
        low_rank, inside = SUFFIX.search(key), key.startswith(prefixes)
        if (inside and not with_base) or (low_rank and (inside or prefix is None)):
            problems.append(f"{key}: not of a layer of this network")
        else:
            skipped.add(key)
    if skipped:
        _say(
            source,
            f"skipped {len(skipped)} tensors that are not of the LoRA, such as "
            f"{quote(min(skipped))}",
        )
    return names, sorted(problems)


def _say(source: Source, note: str) -> None:
    print(printable(f"{source.name}: {note}"), file=sys.stderr)


def _translated(
    source: Source,
    names: Sequence[Name],
    problems: Sequence[str],
    want: Shapes,
    settings: Settings,
) -> dict[str, Change]:
    """Convert a file in a foreign naming; check all shapes before reading values."""
    problems = list(problems)
    roles: dict[Location, dict[str, Name]] = {}
    for name in names:
        if name.role in ("down", "up", "alpha") and not name.location.target.endswith(".kernel"):
            problems.append(f"{name.key}: not of a layer of this network")
        elif roles.setdefault(name.location, {}).setdefault(name.role, name) is not name:
            problems.append(f"{name.key}: duplicate of another name")
    low: dict[Location, Pair] = {}
    full: dict[Location, Tensor] = {}
    for at, named in roles.items():
        try:
            if named.keys() & {"down", "up", "alpha"}:
                low[at] = _pair(at, named, source, want, settings)
            if "diff" in named:
                full[at] = _full(at, source.tensors[named["diff"].key], want, low_rank=at in low)
        except RefusedError as error:
            problems.append(f"{at}: {error}")
    if problems:
        raise InputError(
            f"{len(problems)} tensors of {source.name} are not of a LoRA of this network: "
            f"{listing(problems)}."
        )
    tensors = {name.key: source.tensors[name.key] for name in names}
    bad = [key for key, tensor in tensors.items() if not all_finite(tensor.array())]
    refuse([f"{key}: has values that are not finite" for key in bad])
    if any(pair.alpha is None for pair in low.values()):
        _say(source, "alpha is taken as the rank: no tensor, header or config says another")
    if any(pair.alpha == 0 for pair in low.values()):
        _say(source, "alpha 0 is taken as the rank, as kohya's trainers and LyCORIS do")
    changes: dict[str, Change] = {}
    linear = {at: pair for at, pair in low.items() if at.rule.transform == "linear"}
    for path in dict.fromkeys(at.path for at in linear):
        layers = {at.layer: pair for at, pair in linear.items() if at.path == path}
        changes[path] = _stacked(layers, want[f"{path}.kernel"])
    added = [(at, pair.product()) for at, pair in low.items() if at not in linear]
    added += [(at, tensor.array()) for at, tensor in full.items()]
    for target in dict.fromkeys(at.target for at, _ in added):
        here = [(at, array) for at, array in added if at.target == target]
        values = np.zeros(want[target], _dtype([array for _, array in here]))
        for at, array in here:
            values[... if at.layer is None else at.layer] = at.rule.to_jax(array)
        changes[target] = values
    in_full = {name.key: name for name in names if name.role == "value"}
    return changes | _values(source, in_full, want)


class Pair(NamedTuple):
    """Low-rank tensors of a layer, not yet read, and the factor of their product."""

    down: Tensor
    """Down projection `[r, in]`, or `[r, in, ...]` of a convolution."""
    up: Tensor
    """Up projection `[out, r]`, or with axes of length 1 after it."""
    alpha: float | None
    """Alpha as it is said; None or 0: the rank."""
    scale: float

    def product(self) -> np.ndarray:
        """Return the change of a convolution's kernel `[out, in, ...]`."""
        down, up = (t.array().astype(np.float32) for t in (self.down, self.up))
        product = up.reshape(len(up), -1) @ down.reshape(len(down), -1)
        return self.scale * product.reshape(len(up), *down.shape[1:])


def _pair(
    location: Location,
    named: Mapping[str, Name],
    source: Source,
    want: Shapes,
    settings: Settings,
) -> Pair:
    """Return the low-rank tensors of a layer. Raises `RefusedError` unless they fit its kernel."""
    for role, name in (("down", "lora_A"), ("up", "lora_B")):
        if role not in named:
            raise RefusedError(f"has no {name}")
    down, up = (source.tensors[named[role].key] for role in ("down", "up"))
    rank = down.shape[0] if down.shape else 0
    if not 1 <= rank <= MAX_RANK:
        raise RefusedError(f"has rank {rank}; expected 1 to {MAX_RANK}")
    kernel = want[location.target][location.layer is not None :]
    if (
        up.shape[1:2] != (rank,)
        or math.prod(up.shape[2:]) != 1
        or _shape(location, (up.shape[0], *down.shape[1:])) != kernel
    ):
        raise RefusedError(
            f"has shapes {down.shape} and {up.shape}, whose product is not of the kernel {kernel}"
        )
    alpha = _alpha(location, named.get("alpha"), source)
    if why := settings.misfit(named["down"].layer, rank, alpha):
        raise InputError(
            f"{settings.source} is not of {source.name}: {why}. Give it the settings of its "
            f"adapter, or move {source.name} to a folder without another's."
        )
    alpha = settings.alpha if alpha is None else alpha
    return Pair(down, up, alpha, settings.scale(alpha, rank))


def _alpha(location: Location, name: Name | None, source: Source) -> float | None:
    """Return the alpha in the file of a layer, or None."""
    if name is None or (suffix := SUFFIX.search(name.key)) is None:
        return None
    tensor = source.tensors[name.key]
    if (count := math.prod(tensor.shape)) != 1:
        raise RefusedError(f"has {count} numbers as alpha; expected one")
    return next(said({suffix[1]: tensor.array().item()}, str(location)))[2]


def _full(location: Location, tensor: Tensor, want: Shapes, *, low_rank: bool) -> Tensor:
    """Return a full difference. Raises `RefusedError` unless it fits, alone in a convolution."""
    shape = want[location.target][location.layer is not None :]
    if (have := _shape(location, tensor.shape)) != shape:
        raise RefusedError(f"has shape {have}; expected {shape}")
    if low_rank and location.rule.transform != "linear":
        raise RefusedError("has a full difference and low-rank tensors")
    return tensor


def _shape(location: Location, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of a foreign tensor in our layout, or its own if it does not fit."""
    try:
        return location.rule.to_jax(np.broadcast_to(np.uint8(0), shape)).shape
    except (EinopsError, ValueError):
        return shape


def _stacked(layers: Mapping[int | None, Pair], kernel: tuple[int, ...]) -> Delta:
    """Stack the low-rank tensors of all layers; `up` includes the scale."""
    low = layers.values()
    rank = max(pair.down.shape[0] for pair in low)
    *stacked, wide, out = kernel
    down = np.zeros((*stacked, wide, rank), _dtype([pair.down for pair in low]))
    same = all(pair.scale == 1 for pair in low)
    up_dtype = _dtype([pair.up for pair in low]) if same else np.float32
    up = np.zeros((*stacked, rank, out), up_dtype)
    for number, pair in layers.items():
        here, at = pair.down.shape[0], ... if number is None else number
        down[at][:, :here] = pair.down.array().T
        up[at][:here] = pair.scale * pair.up.array().astype(np.float32).reshape(out, here).T
    return Delta(down=down, up=up)


def _dtype(tensors: Sequence[Tensor | np.ndarray]) -> np.dtype:
    """Return the half-precision dtype of all tensors if they share one, else float32."""
    dtypes = {tensor.dtype for tensor in tensors}
    shared = next(iter(dtypes))
    return shared if len(dtypes) == 1 and shared in HALF else np.dtype(np.float32)
