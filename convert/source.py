"""Foreign checkpoints, opened: their tensors by name, mapped and not yet read.

A checkpoint is one file, safetensors or `.pth`, or several with an index that says which tensor
lies in which. Nothing is read but headers until a tensor is asked for its values.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from egosim_jax.convert.pth import read_pth
from egosim_jax.io.mapped import Tensor, read_safetensors
from egosim_jax.io.untrusted import quote, quote_path, read_json
from egosim_jax.types import InputError

INDEX = ".safetensors.index.json"
SHARD = re.compile(r"(.+)-[0-9]{5}-of-([0-9]{5})")
PTH = (".pth", ".pt", ".bin")


@dataclass(frozen=True, kw_only=True)
class Source:
    """One checkpoint."""

    name: str
    """The file's, or what the names of its parts have in common."""
    files: tuple[Path, ...]
    tensors: Mapping[str, Tensor]

    @property
    def bytes(self) -> int:
        """Of all tensors."""
        return sum(math.prod(t.shape) * t.dtype.itemsize for t in self.tensors.values())


def sources(path: Path) -> Iterator[Source]:
    """The checkpoints of a file or folder, without those of folders in it.

    Files of one index, or numbered `NAME-00001-of-00003`, are one. Raises `InputError` if a file is
    damaged or a numbered one is missing, and for a name that two files of one have.
    """
    if not path.is_dir():
        yield _joined(quote_path(path.name), [path])
        return
    left = {f for f in path.iterdir() if f.suffix in (".safetensors", *PTH) and f.is_file()}
    left = {file for file in left if not file.name.startswith(".")}  # half written ones
    for index in sorted(path.glob(f"*{INDEX}")):
        places = _indexed(index)
        files = sorted({index.parent / place for place in places.values()})
        left -= set(files)
        source = _joined(quote_path(index.name.removesuffix(INDEX)), files)
        if lost := places.keys() - source.tensors.keys():
            raise InputError(
                f"{quote_path(index)} names {len(lost)} tensors that its files lack, such as "
                f"{quote(min(lost))}: the files are not all of one download."
            )
        yield source
    groups: dict[str, list[Path]] = {}
    for file in sorted(left):
        part = SHARD.fullmatch(file.stem)
        groups.setdefault(quote_path(part[1] if part else file.name), []).append(file)
    for name, files in groups.items():
        part = SHARD.fullmatch(files[0].stem)
        if part and len(files) != int(part[2]):
            raise InputError(
                f"{quote_path(path)} has {len(files)} of the {int(part[2])} files of {name}."
            )
        yield _joined(name, files)


def _indexed(index: Path) -> dict[str, str]:
    """The file, beside the index and there, of each tensor."""
    match read_json(index):
        case {"weight_map": dict(places)} if places:
            pass
        case _:
            raise InputError(f"{quote_path(index)} is no index of safetensors: no weight_map.")
    for place in set(map(type, places.values())) - {str}:
        raise InputError(f"{quote_path(index)} names a {place.__name__} where a file has to be.")
    beside = set(os.listdir(index.parent))
    for place in sorted(set(places.values())):
        if place not in beside or not place.endswith(".safetensors"):
            raise InputError(
                f"{quote_path(index)} names {quote(place)}, which is no safetensors beside it."
            )
    return places


def _joined(name: str, files: Sequence[Path]) -> Source:
    tensors: dict[str, Tensor] = {}
    for file in files:
        found = read_pth(file) if file.suffix in PTH else read_safetensors(file)
        if twice := tensors.keys() & found.keys():
            raise InputError(
                f"{quote_path(file)} has {quote(min(twice))}, which another file of {name} has."
            )
        tensors |= found
    return Source(name=name, files=tuple(files), tensors=tensors)
