"""Reading of LoRA files in every common naming.

Our own code, because each library reads its own naming alone, and only into PyTorch modules.

`lora_names` takes the names of tensors apart: `lora_A` or `lora_down`, `lora_B` or `lora_up`,
`alpha`, or a full difference of a weight, bias or modulation. A low-rank change of a convolution is
multiplied out. `lora_settings` reads the default alpha, which is the rank if nothing says it.

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
from egosim_jax.convert.lora_names import (
    SUFFIX,
    TEXT,
    Location,
    Name,
    chosen,
    locations,
    parse,
    refuse_others,
)
from egosim_jax.convert.lora_settings import ADAPTER, MERGE, Settings, finite, settings_of
from egosim_jax.convert.source import PTH, Source, sources
from egosim_jax.convert.tables import weight_shapes
from egosim_jax.io.bounded import listing, quote, quote_path, quote_text
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

IN_FULL = "non_lora_weights"
"""Stem of the file next to a LoRA whose weights replace the base's."""
ENDS = (".safetensors", *PTH)
"""Extensions of weight files."""
HALF = (np.dtype(np.float16), np.dtype(ml_dtypes.bfloat16))
"""Dtypes that a LoRA keeps; all others are read as float32."""


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
        settings, known = settings_of(path, source.files[0], metadata), locations(config)
        names, problems = _names(source, known, settings, prefix=prefix, adapter=adapter)
        if settings.saved and in_full is None and all(name.role != "value" for name in names):
            raise InputError(
                f"{settings.source} has modules_to_save {listing(settings.saved)}, but "
                f"{source.name} has no weights of them. {MERGE}"
            )
        with np.errstate(over="ignore", invalid="ignore"):  # `check` refuses values not finite
            changes = _translated(source, names, problems, want, settings)
    if in_full is not None:
        known = locations(config)
        changes |= _values(in_full, {key: parse(key, known) for key in in_full.tensors}, want)
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
    source: Source, names: Mapping[str, Name | None], want: Mapping[str, tuple[int, ...]]
) -> dict[str, Change]:
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
    known: Mapping[str, Location],
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
        print(
            printable(f"{source.name}: skipped {text} tensors of a text encoder"), file=sys.stderr
        )
    refuse_others(keys, source=source.name, fix=MERGE)
    parsed = {key: parse(key, known) for key in keys}
    found = [name for name in parsed.values() if name is not None]
    own = [n for n in found if n.role != "value" or settings.saves(n.owner)]
    names = chosen(own, source=source.name, prefix=prefix, adapter=adapter)
    prefixes = tuple({name.prefix for name in names} or {""})
    with_base = any(BASE_LAYER in key for key in keys)
    skipped, problems = {name.key for name in own} - {name.key for name in names}, []
    for key in parsed.keys() - {name.key for name in own}:
        low_rank, inside = SUFFIX.search(key), key.startswith(prefixes)
        if (inside and not with_base) or (low_rank and (inside or prefix is None)):
            problems.append(f"{key}: not of a layer of this network")
        else:
            skipped.add(key)
    if skipped:
        print(
            f"{source.name}: skipped {len(skipped)} tensors that are not of the LoRA, such as "
            f"{quote(min(skipped))}",
            file=sys.stderr,
        )
    if names and settings.alpha is None and all("base_model." in n.prefix for n in names):
        print(
            f"{source.name}: alpha is taken as the rank, as there is no {ADAPTER} of PEFT next to "
            "the file",
            file=sys.stderr,
        )
    return names, sorted(problems)


def _translated(
    source: Source,
    names: Sequence[Name],
    problems: Sequence[str],
    want: Mapping[str, tuple[int, ...]],
    settings: Settings,
) -> dict[str, Change]:
    """Convert a file in a foreign naming; check all shapes before reading values."""
    problems = list(problems)
    low_rank: dict[Location, dict[str, Name]] = {}
    full: dict[Location, Name] = {}
    for name in names:
        at, low = name.location, name.role in ("down", "up", "alpha")
        taken = low_rank.setdefault(at, {}) if low else full
        if low and not at.target.endswith(".kernel"):
            problems.append(f"{name.key}: not of a layer of this network")
        elif (name.role if low else at) in taken:
            problems.append(f"{name.key}: duplicate of another name")
        elif low:
            low_rank[at][name.role] = name
        elif name.role != "value":
            full[at] = name
    pairs: dict[Location, Pair] = {}
    for location, roles in low_rank.items():
        try:
            if roles:
                pairs[location] = _pair(location, roles, source, want, settings)
        except RefusedError as error:
            problems.append(f"{location}: {error}")
    for location, name in full.items():
        shape = want[location.target][location.layer is not None :]
        have = _shape(location, source.tensors[name.key].shape)
        if have != shape:
            problems.append(f"{location}: has shape {have}; expected {shape}")
        elif location in pairs and location.rule.transform != "linear":
            problems.append(f"{location}: has a full difference and low-rank tensors")
    if problems:
        raise InputError(
            f"{len(problems)} tensors of {source.name} are not of a LoRA of this network: "
            f"{listing(problems)}."
        )
    tensors = {name.key: source.tensors[name.key] for name in names}
    refuse(
        [f"{k}: has values that are not finite" for k, t in tensors.items() if not _is_finite(t)]
    )
    linear = {at: pair for at, pair in pairs.items() if at.rule.transform == "linear"}
    changes: dict[str, Change] = {}
    for path in dict.fromkeys(location.path for location in linear):
        shape = want[f"{path}.kernel"]
        changes[path] = _stacked({p.layer: v for p, v in linear.items() if p.path == path}, shape)
    parts = [(at, pair.product()) for at, pair in pairs.items() if at not in linear]
    parts += [(at, tensors[name.key].array()) for at, name in full.items()]
    for target in dict.fromkeys(location.target for location, _ in parts):
        here = [(at, array) for at, array in parts if at.target == target]
        values = np.zeros(want[target], _dtype([array for _, array in here]))
        for at, array in here:
            values[... if at.layer is None else at.layer] = at.rule.to_jax(array)
        changes[target] = values
    return changes | _values(
        source, {name.key: name for name in names if name.role == "value"}, want
    )


class Pair(NamedTuple):
    """Low-rank tensors of a layer, not yet read, and the factor of their product."""

    down: Tensor
    """Down projection `[r, in]`, or `[r, in, ...]` of a convolution."""
    up: Tensor
    """Up projection `[out, r]`, or with axes of length 1 after it."""
    scale: float

    def product(self) -> np.ndarray:
        """Return the change of a convolution's kernel `[out, in, ...]`."""
        down, up = (t.array().astype(np.float32) for t in (self.down, self.up))
        product = up.reshape(len(up), -1) @ down.reshape(len(down), -1)
        return self.scale * product.reshape(len(up), *down.shape[1:])


def _pair(
    location: Location,
    roles: Mapping[str, Name],
    source: Source,
    want: Mapping[str, tuple[int, ...]],
    settings: Settings,
) -> Pair:
    """Return the low-rank tensors of a layer. Raises `RefusedError` unless they fit its kernel."""
    for role, name in (("down", "lora_A"), ("up", "lora_B")):
        if role not in roles:
            raise RefusedError(f"has no {name}")
    down, up = (source.tensors[roles[role].key] for role in ("down", "up"))
    rank = down.shape[0] if down.shape else 0
    if not 1 <= rank <= MAX_RANK:
        raise RefusedError(f"has rank {rank}; expected 1 to {MAX_RANK}")
    kernel = want[location.target][location.layer is not None :]
    if location.rule.transform == "linear":
        wide, out = kernel
        if (down.shape, up.shape) != ((rank, wide), (out, rank)):
            raise RefusedError(
                f"has shapes {down.shape} and {up.shape}; expected {(rank, wide)} and {(out, rank)}"
            )
    elif (
        up.shape[1:2] != (rank,)
        or math.prod(up.shape[2:]) != 1
        or _shape(location, (up.shape[0], *down.shape[1:])) != kernel
    ):
        raise RefusedError(
            f"has shapes {down.shape} and {up.shape}, whose product is not of the kernel {kernel}"
        )
    alpha = None
    if (scalar := roles.get("alpha")) is not None:
        tensor = source.tensors[scalar.key]
        if (count := math.prod(tensor.shape)) != 1:
            raise RefusedError(f"has {count} numbers as alpha; expected one")
        alpha = finite(float(tensor.array().item()), f"The alpha of {location}")
    if why := settings.misfit(roles["down"].layer, rank, alpha):
        raise InputError(
            f"{settings.source} is not of {source.name}: {why}. Give it the file of its "
            f"adapter, or move {source.name} to a folder without one."
        )
    return Pair(down, up, settings.scale(alpha, rank))


def _shape(location: Location, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of a foreign tensor in our layout, or its own if it does not fit."""
    try:
        return location.rule.to_jax(np.broadcast_to(np.uint8(0), shape)).shape
    except (EinopsError, ValueError):
        return shape


def _is_finite(tensor: Tensor) -> bool:
    """Return True if all values of a tensor are finite."""
    return all_finite(tensor.array())


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


def _dtype(tensors: Sequence[Tensor | np.ndarray]) -> np.dtype:
    """Return the half-precision dtype of all tensors if they share one, else float32."""
    dtypes = {tensor.dtype for tensor in tensors}
    shared = next(iter(dtypes))
    return shared if len(dtypes) == 1 and shared in HALF else np.dtype(np.float32)
