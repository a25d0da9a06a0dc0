"""LoRA files, in all names that people train them in, and out in one that all load.

A file names a layer of the video transformer as Wan's or diffusers' table does, behind a prefix
(`diffusion_model.`, `transformer.`, `base_model.model.`, `lora_unet_`), with dots or, in kohya's
names, underscores; then says what it is: `lora_A` or `lora_down`, `lora_B` or `lora_up`, `alpha`.
Without an alpha it is the rank, unless PEFT's `adapter_config.json` or the file's header says so.
What is written has Wan's names behind `diffusion_model.`, as ComfyUI and diffusers both read them,
with an alpha for each layer, and rank, alpha and the base's hash in the header.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from egosim_jax.convert.source import sources
from egosim_jax.convert.tables import wan_dit
from egosim_jax.io.mapped import Tensor, read_metadata
from egosim_jax.models.lora import BASE, OURS, Delta, from_tensors
from egosim_jax.models.wan_dit import WanDiTConfig
from egosim_jax.types import InputError

PREFIXES = (
    "base_model.model.", "diffusion_model.", "model.", "transformer.", "pipe.dit.", "dit.",
    "lora_unet_", "lora_transformer_", "_",
)  # fmt: skip
ENDS: dict[str, Literal["down", "up", "alpha"]] = {
    "lora_A": "down", "lora_down": "down", "lora_B": "up", "lora_up": "up", "alpha": "alpha",
}  # fmt: skip
END = re.compile(rf"\.({'|'.join(ENDS)})(\.default)?(\.weight)?")
ADAPTER = "adapter_config.json"
EXPORTED = "diffusion_model."


class Place(NamedTuple):
    """A linear layer: our path and, in a stack of blocks, which of them."""

    path: str
    layer: int | None


@dataclass(frozen=True, kw_only=True)
class Layer:
    """What a file has for one linear layer, in torch's layout."""

    down: np.ndarray
    """`[r, in]`."""
    up: np.ndarray
    """`[out, r]`."""
    alpha: float

    @property
    def scale(self) -> float:
        """alpha / r."""
        return self.alpha / len(self.down)


def read_lora(path: Path, config: WanDiTConfig) -> dict[str, Delta]:
    """The summands of a LoRA by our paths, in float32; one that we trained has them already.

    `path` is a file, or PEFT's folder of one with its config. Blocks that it does not have get 0,
    lower ranks than the highest of a stack are filled up with 0. Raises `InputError` listing every
    tensor that is of no linear layer, and every layer of which one of the two is missing or whose
    shapes do not fit.
    """
    (source,) = _only(path)
    if _is_ours(source.files[0]):
        arrays = {name: tensor.array() for name, tensor in source.tensors.items()}
        return from_tensors(arrays)
    alpha = _default_alpha(path, source.files[0])
    stacks: dict[str, dict[int | None, Layer]] = {}
    for place, layer in _layers(source.tensors, config, alpha, name=source.name).items():
        stacks.setdefault(place.path, {})[place.layer] = layer
    return {path: _stacked(layers, config) for path, layers in stacks.items()}


def _only(path: Path) -> list:
    found = list(sources(path))
    if len(found) != 1:
        raise InputError(f"{path} holds {len(found)} files of weights; a LoRA is one. (--lora)")
    return found


def _is_ours(file: Path) -> bool:
    return file.suffix == ".safetensors" and read_metadata(file).get("format") == OURS


def _default_alpha(path: Path, file: Path) -> float | None:
    """The alpha of layers that do not say theirs, if anything does."""
    adapter = (path if path.is_dir() else path.parent) / ADAPTER
    if adapter.is_file():
        return float(json.loads(adapter.read_text(encoding="utf-8"))["lora_alpha"])
    about = read_metadata(file) if file.suffix == ".safetensors" else {}
    said = about.get("alpha", about.get("ss_network_alpha"))
    return None if said is None else float(said)


def _layers(
    tensors: Mapping[str, Tensor], config: WanDiTConfig, alpha: float | None, *, name: str
) -> dict[Place, Layer]:
    """What the file has, layer by layer."""
    places = _places(config)
    parts: dict[Place, dict[str, np.ndarray]] = {}
    problems = []
    for key, tensor in tensors.items():
        end = END.search(key)
        place = places.get(_plain(key[: end.start()])) if end else None
        if end is None or place is None or key[end.end() :]:
            problems.append(f"{key}: not of a linear layer of this network")
            continue
        kind = ENDS[end[1]]
        if kind in parts.setdefault(place, {}):
            problems.append(f"{key}: is there twice, under another name")
        parts[place][kind] = tensor.array().astype(np.float32)
    layers = {}
    for place, found in parts.items():
        where = place.path if place.layer is None else f"{place.path}, block {place.layer}"
        down, up = found.get("down"), found.get("up")
        if down is None or up is None:
            problems.append(f"{where}: has no {'lora_A' if down is None else 'lora_B'}")
        elif down.ndim != 2 or up.ndim != 2 or len(down) != up.shape[1]:
            problems.append(f"{where}: {down.shape} and {up.shape} are no product")
        else:
            said = float(found["alpha"].item()) if "alpha" in found else alpha
            said = float(len(down)) if said is None else said
            layers[place] = Layer(down=down, up=up, alpha=said)
    if problems:
        listing = "\n".join(f"  {line}" for line in problems)
        raise InputError(
            f"{len(problems)} tensors of {name} are no LoRA of the network:\n{listing}"
        )
    return layers


def _stacked(layers: Mapping[int | None, Layer], config: WanDiTConfig) -> Delta:
    """Ours, with alpha / r in the second."""
    rank = max(len(layer.down) for layer in layers.values())
    first = next(iter(layers.values()))
    wide, out = first.down.shape[1], first.up.shape[0]
    count = 1 if None in layers else config.layers
    down, up = np.zeros((count, wide, rank), np.float32), np.zeros((count, rank, out), np.float32)
    for number, layer in layers.items():
        here = len(layer.down)
        down[number or 0, :, :here] = layer.down.T
        up[number or 0, :here] = layer.scale * layer.up.T
    return Delta(down=down[0], up=up[0]) if None in layers else Delta(down=down, up=up)


def exported(deltas: Mapping[str, Delta], config: WanDiTConfig) -> dict[str, np.ndarray]:
    """The tensors of a LoRA file; alpha is the rank, since the second has it in it."""
    tensors = {}
    for theirs, place in _names(config).items():
        if place.path in deltas:
            delta = deltas[place.path]
            down = delta.down if place.layer is None else delta.down[place.layer]
            up = delta.up if place.layer is None else delta.up[place.layer]
            tensors[f"{EXPORTED}{theirs}.lora_A.weight"] = np.ascontiguousarray(down.T)
            tensors[f"{EXPORTED}{theirs}.lora_B.weight"] = np.ascontiguousarray(up.T)
            tensors[f"{EXPORTED}{theirs}.alpha"] = np.array(down.shape[-1], np.float32)
    return tensors


def base_of(path: Path) -> dict[str, str]:
    """What a file's header says of the weights that the LoRA was trained on."""
    about = read_metadata(path) if path.suffix == ".safetensors" else {}
    return {BASE: about[BASE]} if BASE in about else {}


def about_lora(deltas: Mapping[str, Delta]) -> dict[str, str]:
    """What the header of a LoRA file says."""
    ranks = {delta.down.shape[-1] for delta in deltas.values()}
    rank = str(max(ranks))
    return {"format": "pt", "rank": rank, "alpha": rank}


def _names(config: WanDiTConfig) -> dict[str, Place]:
    """The linear layers by Wan's names."""
    return _by_name(wan_dit.wan(config), config)


def _places(config: WanDiTConfig) -> dict[str, Place]:
    """The linear layers by both tables' names, without what files write differently."""
    both = _by_name(wan_dit.diffusers(config), config) | _names(config)
    return {_plain(name): place for name, place in both.items()}


def _by_name(rules: list, config: WanDiTConfig) -> dict[str, Place]:
    found = {}
    for rule in rules:
        if rule.transform == "linear":
            name, path = rule.source.removesuffix(".weight"), rule.target.removesuffix(".kernel")
            for layer in range(config.layers) if rule.stacked else (None,):
                found[name.replace("*", str(layer))] = Place(path, layer)
    return found


def _plain(name: str) -> str:
    """A layer's name without prefixes, and with underscores for dots."""
    while prefix := next((p for p in PREFIXES if name.startswith(p)), None):
        name = name.removeprefix(prefix)
    return name.replace(".", "_")
