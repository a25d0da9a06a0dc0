"""LoRA files, in all names that people train them in, and out in one that all load.

A file names a layer of the video transformer as Wan's or diffusers' table does, behind a prefix
(`diffusion_model.`, `transformer.`, `base_model.model.`, `lora_unet_`), with dots or, in kohya's
names, underscores; then says what it is: `lora_A` or `lora_down`, `lora_B` or `lora_up`, `alpha`,
or what is added to a whole weight, bias or modulation: `diff`, `diff_b`, `diff_m`. Without an alpha
it is the rank, unless PEFT's `adapter_config.json` or the file's header says so. What is written
has Wan's names behind `diffusion_model.`, as ComfyUI and diffusers both read them, with an alpha
for each layer, and rank, alpha and the base's hash in the header.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from einops import EinopsError

from egosim_jax.convert.rules import Rule, shape_only
from egosim_jax.convert.skeleton import shapes
from egosim_jax.convert.source import Source, sources
from egosim_jax.convert.tables import wan_dit
from egosim_jax.io.mapped import OURS, RefusedError, Tensor, read_metadata
from egosim_jax.io.untrusted import listing, parse_json, quote, quote_path, quote_text, read_json
from egosim_jax.models.lora import (
    BASE,
    MOST_RANK,
    Change,
    Delta,
    check,
    from_tensors,
    misfit,
    pairs,
    refuse,
)
from egosim_jax.models.wan.config import WanDiTConfig
from egosim_jax.types import InputError

PREFIXES = (
    "base_model.model.", "diffusion_model.", "model.", "transformer.", "pipe.dit.", "dit.",
    "lora_unet_", "lora_transformer_", "_",
)  # fmt: skip
TEXT = ("lora_te", "text_encoder.", "text_encoders.")
"""How the names of layers of a text encoder begin."""
LOW_RANK = {
    "lora_A": "down", "lora_down": "down", "lora_B": "up", "lora_up": "up", "alpha": "alpha",
}  # fmt: skip
WHOLE = {"diff": "weight", "diff_b": "bias", "diff_m": "modulation"}
"""What the end of a name stands for."""
END = re.compile(rf"\.({'|'.join((*LOW_RANK, *WHOLE))})(\.default)?(\.weight)?$")
ADAPTER, ADAPTER_ENTRY = "adapter_config.json", "lora_adapter_metadata"
"""PEFT's settings: a file, and what diffusers calls them in a header."""
EXPORTED = "diffusion_model."


@dataclass(frozen=True)
class Place:
    """A weight and, in a stack of blocks, which of them."""

    target: str
    """Our path of it."""
    layer: int | None
    rule: Rule = field(compare=False)
    """How it is written in the names that it was found under."""

    @property
    def path(self) -> str:
        """Of a kernel that of its layer."""
        return self.target.removesuffix(".kernel")

    def __str__(self) -> str:
        return self.path if self.layer is None else f"{self.path}, block {self.layer}"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What a LoRA says of itself as a whole."""

    alpha: float | None = None
    """That of layers that do not say theirs; None: the rank."""
    root: bool = False
    """Whether the scale is alpha / sqrt(r), as rsLoRA's, and not alpha / r."""

    def scale(self, alpha: float | None, rank: int) -> float:
        """What a product of a rank counts."""
        said = self.alpha if alpha is None else alpha
        return 1.0 if said is None else said / (math.sqrt(rank) if self.root else rank)


def read_lora(path: Path, config: WanDiTConfig) -> dict[str, Change]:
    """The summands of a LoRA by our paths, in float32; one that we trained has them already.

    `path` is a file, or PEFT's folder of one with its config. Blocks that it does not have get 0,
    lower ranks than the highest of a stack are filled up with 0. Layers of a text encoder are left
    out, which is said. Raises `InputError` listing every tensor that is of nothing else in the
    network or does not fit, and every value that is not finite.
    """
    source = _only(path)
    want = shapes("dit", config)
    about = metadata_of(source.files[0])
    if about.get("format") == OURS:
        found = pairs(source.tensors)
        whys = {at: misfit(want, at, down.shape, up.shape) for at, (down, up) in found.items()}
        refuse([f"{at}: {why}" for at, why in whys.items() if why])
        arrays = {name: tensor.array() for name, tensor in source.tensors.items()}
        changes: dict[str, Change] = {**from_tensors(arrays)}
    else:
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite then is refused
            changes = _translated(source, config, want, _settings(path, about))
    if not changes:
        raise InputError(f"{quote_path(path)} holds nothing of the network's layers. (--lora)")
    check(want, changes)
    return changes


def metadata_of(file: Path) -> dict[str, str]:
    """What the header of a file says, if it can."""
    return read_metadata(file) if file.suffix == ".safetensors" else {}


def check_base(path: Path, known: Collection[str]) -> None:
    """Raise `InputError` if a LoRA says that it was trained on weights of another hash."""
    said = metadata_of(_only(path).files[0]).get(BASE)
    if said is not None and said not in known:
        raise InputError(
            f"{quote_path(path)} was trained on other weights: those have {BASE} "
            f"{quote_text(said[:12])}…, these {', '.join(f'{name[:12]}…' for name in known)}. Take "
            "the weights that it was trained on; or, to merge it into others, name those, too. "
            "(--base)"
        )


def _only(path: Path) -> Source:
    found = list(sources(path))
    if len(found) != 1:
        raise InputError(
            f"{quote_path(path)} holds {len(found)} files of weights; a LoRA is one. (--lora)"
        )
    return found[0]


def _settings(path: Path, about: Mapping[str, str]) -> Settings:
    """What the adapter's config or the header says."""
    adapter = (path if path.is_dir() else path.parent) / ADAPTER
    if os.path.lexists(adapter):
        return _peft(read_json(adapter), source=quote_path(adapter))
    if ADAPTER_ENTRY in about:
        source = f"{ADAPTER_ENTRY} of {quote_path(path)}"
        said = parse_json(about[ADAPTER_ENTRY].encode(), source=source)
        return _peft(
            {name.removeprefix("transformer."): value for name, value in said.items()}
            if isinstance(said, dict)
            else said,
            source=source,
        )
    said = about.get("alpha", about.get("ss_network_alpha", "None"))
    if said in ("None", ""):
        return Settings()
    return Settings(alpha=_number(said, f"The alpha of {quote_path(path)}"))


def _peft(said: Any, *, source: str) -> Settings:
    match said:
        case {"lora_alpha": alpha}:
            pass
        case _:
            raise InputError(f"{source} has no lora_alpha, which PEFT writes. Add it.")
    if said.get("alpha_pattern"):
        raise InputError(f"{source} has an alpha_pattern, which is not read: give one lora_alpha.")
    return Settings(
        alpha=_number(alpha, f"lora_alpha of {source}"), root=said.get("use_rslora") is True
    )


def _number(value: Any, what: str) -> float:
    """A finite number. Raises `InputError` for everything else."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{what} is {quote(value)}, which is no finite number.")
    return number


def _translated(
    source: Source,
    config: WanDiTConfig,
    want: Mapping[str, tuple[int, ...]],
    settings: Settings,
) -> dict[str, Change]:
    """What a file in foreign names adds; shapes are checked before values are read."""
    known = _places(config)
    low: dict[Place, dict[str, Tensor]] = {}
    whole: dict[Place, Tensor] = {}
    problems, text = [], 0
    for key, tensor in source.tensors.items():
        if key.startswith(TEXT):
            text += 1
            continue
        end = END.search(key)
        kind = end[1] if end else ""
        stem = f"{_plain(key[: end.start()])}_{WHOLE.get(kind, 'weight')}" if end else ""
        place = known.get(stem)
        if place is None or (kind in LOW_RANK and place.rule.transform != "linear"):
            problems.append(f"{key}: not of a layer of this network")
        elif (kind in WHOLE and place in whole) or LOW_RANK.get(kind) in low.get(place, {}):
            problems.append(f"{key}: is there twice, under another name")
        elif kind in LOW_RANK:
            low.setdefault(place, {})[LOW_RANK[kind]] = tensor
        else:
            whole[place] = tensor
    if text:
        print(f"{source.name}: {text} tensors of a text encoder are left out", file=sys.stderr)
    pairs = {}
    for place, found in low.items():
        try:
            pairs[place] = _pair(place, found, want[f"{place.path}.kernel"][-2:], settings)
        except RefusedError as error:
            problems.append(f"{place}: {error}")
    for place, tensor in whole.items():
        shape = want[place.target][place.layer is not None :]
        try:
            have = place.rule.to_jax(shape_only(tensor)).shape
        except (EinopsError, ValueError):
            have = tensor.shape
        if have != shape:
            problems.append(f"{place}: have {have}, want {shape}")
    if problems:
        what = f"{len(problems)} tensors of {source.name} are no LoRA of the network"
        raise InputError(f"{what}: {listing(problems)}.")
    changes: dict[str, Change] = {}
    for path in dict.fromkeys(place.path for place in pairs):
        shape = want[f"{path}.kernel"]
        changes[path] = _stacked({p.layer: v for p, v in pairs.items() if p.path == path}, shape)
    for target in dict.fromkeys(place.target for place in whole):
        values = np.zeros(want[target], np.float32)
        for place in (place for place in whole if place.target == target):
            layer = ... if place.layer is None else place.layer
            values[layer] = place.rule.to_jax(whole[place].array())
        changes[target] = values
    return changes


class Pair(NamedTuple):
    """The two of a layer, not read yet, and what their product counts."""

    down: Tensor
    """`[r, in]`."""
    up: Tensor
    """`[out, r]`."""
    scale: float


def _pair(
    place: Place, found: Mapping[str, Tensor], kernel: tuple[int, ...], settings: Settings
) -> Pair:
    """The two of a layer. Raises `RefusedError` unless they are of its size."""
    for end, name in (("down", "lora_A"), ("up", "lora_B")):
        if end not in found:
            raise RefusedError(f"has no {name}")
    down, up = found["down"], found["up"]
    rank = down.shape[0] if down.shape else 0
    if not 1 <= rank <= MOST_RANK:
        raise RefusedError(f"has rank {rank}, want 1 to {MOST_RANK}")
    wide, out = kernel
    if (down.shape, up.shape) != ((rank, wide), (out, rank)):
        raise RefusedError(
            f"have {down.shape} and {up.shape}, want {(rank, wide)} and {(out, rank)}"
        )
    alpha = None
    if (said := found.get("alpha")) is not None:
        if math.prod(said.shape) != 1:
            raise RefusedError(f"has {math.prod(said.shape)} numbers as alpha")
        alpha = _number(float(said.array().item()), f"The alpha of {place}")
    return Pair(down, up, settings.scale(alpha, rank))


def _stacked(layers: Mapping[int | None, Pair], kernel: tuple[int, ...]) -> Delta:
    """Ours, with the scale in the second."""
    rank = max(pair.down.shape[0] for pair in layers.values())
    *stacked, wide, out = kernel
    down = np.zeros((*stacked, wide, rank), np.float32)
    up = np.zeros((*stacked, rank, out), np.float32)
    for number, pair in layers.items():
        here, at = pair.down.shape[0], ... if number is None else number
        down[at][:, :here] = pair.down.array().T
        up[at][:here] = pair.scale * pair.up.array().astype(np.float32).T
    return Delta(down=down, up=up)


def exported(changes: Mapping[str, Change], config: WanDiTConfig) -> dict[str, np.ndarray]:
    """The tensors of a LoRA file; alpha is the rank, since the second has it in it."""
    tensors = {}
    ends = {kind: end for end, kind in WHOLE.items()}
    for theirs, place in _by_name(wan_dit.wan(config), config).items():
        name, _, kind = theirs.rpartition(".")
        layer = ... if place.layer is None else place.layer
        delta, whole = changes.get(place.path), changes.get(place.target)
        if isinstance(delta, Delta) and place.rule.transform == "linear":
            down, up = delta.down[layer], delta.up[layer]
            tensors[f"{EXPORTED}{name}.lora_A.weight"] = np.ascontiguousarray(down.T)
            tensors[f"{EXPORTED}{name}.lora_B.weight"] = np.ascontiguousarray(up.T)
            tensors[f"{EXPORTED}{name}.alpha"] = np.array(down.shape[-1], np.float32)
        if isinstance(whole, np.ndarray) and whole[layer].any():
            values = place.rule.to_torch(whole[layer])
            tensors[f"{EXPORTED}{name}.{ends[kind]}"] = np.ascontiguousarray(values)
    return tensors


def about_lora(changes: Mapping[str, Change]) -> dict[str, str]:
    """What the header of a LoRA file says."""
    ranks = {change.down.shape[-1] for change in changes.values() if isinstance(change, Delta)}
    rank = str(max(ranks, default=0))
    return {"format": "pt"} | ({"rank": rank, "alpha": rank} if ranks else {})


def _places(config: WanDiTConfig) -> dict[str, Place]:
    """The weights by both tables' names, without what files write differently."""
    both = _by_name(wan_dit.diffusers(config), config) | _by_name(wan_dit.wan(config), config)
    return {_plain(name): place for name, place in both.items()}


def _by_name(rules: list[Rule], config: WanDiTConfig) -> dict[str, Place]:
    return {
        rule.source.replace("*", str(layer)): Place(rule.target, layer, rule)
        for rule in rules
        for layer in (range(config.layers) if rule.stacked else (None,))
    }


def _plain(name: str) -> str:
    """A layer's name without prefixes, and with underscores for dots."""
    while prefix := next((p for p in PREFIXES if name.startswith(p)), None):
        name = name.removeprefix(prefix)
    return name.replace(".", "_")
