"""Foreign checkpoints, opened: their tensors by name, mapped and not yet read.

A checkpoint is one file, safetensors or `.pth`, or several with an index that says which tensor
lies in which. Nothing is read but headers until a tensor is asked for its values.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from egosim_jax.convert.pth import read_pth
from egosim_jax.io.mapped import Tensor, read_safetensors
from egosim_jax.types import InputError

INDEX = ".safetensors.index.json"
SHARD = re.compile(r"(.+)-\d{5}-of-(\d{5})")
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
    if path.is_file():
        yield _joined(path.name, [path])
        return
    if not path.is_dir():
        raise InputError(f"{path} is not there. (--source)")
    left = {f for f in path.iterdir() if f.suffix in (".safetensors", *PTH) and f.is_file()}
    for index in sorted(path.glob(f"*{INDEX}")):
        files = _indexed(index)
        left -= set(files)
        yield _joined(index.name.removesuffix(INDEX), files)
    groups: dict[str, list[Path]] = {}
    for file in sorted(left):
        part = SHARD.fullmatch(file.stem)
        groups.setdefault(part[1] if part else file.name, []).append(file)
    for name, files in groups.items():
        part = SHARD.fullmatch(files[0].stem)
        if part and len(files) != int(part[2]):
            raise InputError(f"{path} has {len(files)} of the {int(part[2])} files of {name}.")
        yield _joined(name, files)


def _indexed(index: Path) -> list[Path]:
    """The files of an index, all there."""
    try:
        places = json.loads(index.read_text(encoding="utf-8"))["weight_map"]
        files = sorted({index.parent / place for place in places.values()})
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{index} is no index of safetensors: {error!r}.") from error
    for file in files:
        if file.parent != index.parent or not file.is_file():
            raise InputError(f"{index} names {file.name}, which is not beside it.")
    return files


def _joined(name: str, files: Sequence[Path]) -> Source:
    tensors: dict[str, Tensor] = {}
    for file in files:
        found = read_pth(file) if file.suffix in PTH else read_safetensors(file)
        if twice := sorted(tensors.keys() & found.keys()):
            raise InputError(f"{file} has {', '.join(twice)}, which another file of {name} has.")
        tensors |= found
    return Source(name=name, files=tuple(files), tensors=tensors)
