"""Detection of the networks in a foreign checkpoint, and of their namings.

The signature key of a naming identifies a network; the text before it is the prefix of all its
keys. Folders are searched as downloaded: EgoSim's and Wan's releases have all files side by side,
diffusers' have a folder per network, and the tokenizer has a separate folder.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from egosim_jax.convert.source import Source, sources
from egosim_jax.convert.tables import Table, tables_of
from egosim_jax.io.bounded import quote, quote_path
from egosim_jax.io.mapped import Tensor
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig

T5 = "spiece.model"
"""File of T5's tokenizers only: Wan's releases also have the tokenizer of CLIP's text encoder."""
TOKENIZER = ("tokenizer.json", T5)
"""Files that identify the folder of a tokenizer."""
BASE_LAYER, LORA = ".base_layer.", ".lora_"
"""PEFT's infixes in tensor names of an adapted layer: of its weights, and of the LoRA."""
MAX_DEPTH = 2
"""Levels of subfolders to search."""
MAX_NETWORKS = 16


@dataclass(frozen=True, kw_only=True)
class DetectedNetwork:
    """Network in a foreign checkpoint."""

    network: str
    table: Table
    naming: str
    prefix: str
    """Prefix of all its keys, such as `diffusion_model.` in ComfyUI's files."""
    source: Source
    others: tuple[str, ...] = ()
    """Longer prefixes of other networks in the checkpoint."""

    @property
    def tensors(self) -> Mapping[str, Tensor]:
        """Tensors of the network by name, without the prefix and PEFT's additions."""
        cut = len(self.prefix)
        skipped = set(self.low_rank)
        return {
            name[cut:].replace(BASE_LAYER, "."): tensor
            for name, tensor in self.source.tensors.items()
            if name.startswith(self.prefix)
            and name not in skipped
            and not (self.others and name.startswith(self.others))
        }

    @property
    def low_rank(self) -> list[str]:
        """Names of PEFT's low-rank tensors, which are not weights of the network."""
        names = self.source.tensors.keys()
        layers = {name.partition(BASE_LAYER)[0] for name in names if BASE_LAYER in name}
        return [name for name in names if LORA in name and name.partition(LORA)[0] in layers]


@dataclass(frozen=True, kw_only=True)
class Folder:
    """Networks and tokenizer of a checkpoint file or folder."""

    path: Path
    found: tuple[DetectedNetwork, ...]
    unknown: tuple[Source, ...]
    tokenizer: Path | None
    """Folder of the tokenizer, if any: the nearest of T5, else the nearest."""

    def network(self, name: str) -> DetectedNetwork:
        """Return the only checkpoint of a network. Raises `InputError` for 0 or several."""
        here = [found for found in self.found if found.network == name]
        if len(here) == 1:
            return here[0]
        has = f"{quote_path(self.path)} holds {len(here)} checkpoints of the network {name}"
        if not here:
            names = ", ".join(dict.fromkeys(found.network for found in self.found)) or "none"
            raise InputError(f"{has}. Choose from its networks, {names}. (--only)")
        if len({found.source.files for found in here}) == 1:
            prefixes = ", ".join(quote(found.prefix) for found in here)
            raise InputError(
                f"{has} in one file, with {prefixes} before the names: choose one. (--prefix)"
            )
        files = ", ".join(quote_path(os.path.relpath(f.source.path, self.path)) for f in here)
        raise InputError(f"{has} ({files}): give the path of one of them.")

    def check_complete(self, config: ModelConfig, names: Iterable[str], *, out: Path) -> None:
        """Raise `InputError` if a folder lacks a network of the config; warn if a file does.

        Networks in `names` are converted, and those in the weights folder `out` are there.
        """
        there = {*names, *(path.stem for path in out.glob("[!.]*.safetensors"))}
        missing = ", ".join(name for name in config.networks if name not in there)
        if missing and self.path.is_dir():
            raise InputError(
                f"{quote_path(self.path)} has no {missing}, which {config.name} needs; it has "
                f"{', '.join(names)}. Add the missing files, or convert what it has. (--only "
                f"{' '.join(names)})"
            )
        if missing:
            print(f"still missing in {quote_path(out)}: {missing}", file=sys.stderr)

    def only(self, prefix: str | None) -> Folder:
        """Return the folder with one checkpoint of each network that has several in a file.

        `prefix` is the text before the names, or its first parts. Raises `InputError` if no
        network has it.
        """
        if prefix is None:
            return self
        wanted = prefix.rstrip(".")
        here = [f for f in self.found if f.prefix.rstrip(".") == wanted]
        here = here or [f for f in self.found if f.prefix.startswith(f"{wanted}.")]
        if not here:
            known = ", ".join(dict.fromkeys(quote(found.prefix) for found in self.found)) or "none"
            raise InputError(
                f"{quote_path(self.path)} has no network after {quote(prefix)}. Its prefixes: "
                f"{known}. (--prefix)"
            )
        chosen = {(found.network, found.source.files) for found in here}
        kept = [f for f in self.found if f in here or (f.network, f.source.files) not in chosen]
        return replace(self, found=tuple(kept))


def detect(path: Path, config: ModelConfig | None = None) -> Folder:
    """Search a file or folder for networks. Raises `InputError` if it holds no checkpoint.

    The tables of `config` take precedence over the tables of the registered models.
    """
    tables = known_tables(config)
    found, unknown, tokenizers = [], [], []
    for folder in _folders(path):
        if folder.is_dir() and any((folder / name).is_file() for name in TOKENIZER):
            tokenizers.append(folder)
        for source in sources(folder):
            here = networks_of(source, tables)
            found += here
            unknown += [] if here else [source]
    if not found and not unknown:
        raise InputError(
            f"{quote_path(path)} holds no checkpoint: no .safetensors, .pth, .pt or .bin."
        )
    tokenizer = min(tokenizers, key=lambda folder: not (folder / T5).is_file(), default=None)
    return Folder(path=path, found=tuple(found), unknown=tuple(unknown), tokenizer=tokenizer)


def known_tables(config: ModelConfig | None = None) -> list[tuple[str, Table]]:
    """Return the network names and tables of a config, then of all registered models."""
    from egosim_jax import configs

    registered = map(configs.get, configs.names())
    return tables_of([*(() if config is None else (config,)), *registered])


def networks_of(source: Source, tables: Iterable[tuple[str, Table]]) -> list[DetectedNetwork]:
    """Return the networks of a checkpoint; a ComfyUI file can hold several, each with a prefix."""
    found: dict[tuple[str, str], dict[Table, DetectedNetwork]] = {}
    keys = [key.replace(BASE_LAYER, ".") for key in source.tensors]
    for network, table in tables:
        for naming, names in table.namings.items():
            for key in keys:
                prefix = key.removesuffix(names.signature)
                if prefix != key and (not prefix or prefix.endswith(".")):
                    detected = DetectedNetwork(
                        network=network, table=table, naming=naming, prefix=prefix, source=source
                    )
                    found.setdefault((network, prefix), {}).setdefault(table, detected)
    if len(found) > MAX_NETWORKS:
        raise InputError(
            f"{source.name} holds {len(found)} networks; the limit is {MAX_NETWORKS} per file. "
            "Split it."
        )
    prefixes = {prefix for _, prefix in found}
    return [
        replace(
            _fitting(list(alike.values())),
            others=tuple(p for p in prefixes if p.startswith(prefix) and p != prefix),
        )
        for (_, prefix), alike in found.items()
    ]


def _fitting(alike: Sequence[DetectedNetwork]) -> DetectedNetwork:
    """Return the first network whose table takes the tensors; the first one if none does."""
    for one in alike if len(alike) > 1 else ():
        with suppress(InputError):
            one.table.check(one.tensors)
            return one
    return alike[0]


def _folders(path: Path) -> list[Path]:
    """Return the path and its visible subfolders, nearest first."""
    found, layer = [path], [path]
    for _ in range(MAX_DEPTH if path.is_dir() else 0):
        layer = sorted(
            inner
            for outer in layer
            for inner in outer.iterdir()
            if inner.is_dir() and not inner.name.startswith(".")
        )
        found += layer
    return found
