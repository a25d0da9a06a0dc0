"""Foreign checkpoints: tensors by name, memory-mapped, and the files of a tokenizer.

A checkpoint is one file (safetensors or `.pth`), or several with an index that maps each tensor to
its file. Only headers are read until a caller accesses the values of a tensor.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from egosim_jax.io.bounded import quote, quote_path, read_bytes, read_json
from egosim_jax.io.mapped import Tensor, read_safetensors
from egosim_jax.io.untrusted.pth import SUFFIXES, read_pth
from egosim_jax.types import InputError

INDEX = ".safetensors.index.json"
SHARD = re.compile(r"(.+)-[0-9]{5}-of-([0-9]{5})")
WRAPPER = re.compile(r"(^|(?<=\.))(_orig_mod|_fsdp_wrapped_module|_checkpoint_wrapped_module)\.")
"""Parts that torch's wrappers of modules add to names."""
TOKENIZER_FILES = (
    "tokenizer.json", "spiece.model", "tokenizer_config.json", "special_tokens_map.json",
)  # fmt: skip
MAX_FILES = 1000
"""Maximum number of the files of a checkpoint that one of them names."""
MAX_TOKENIZER = 64 << 20
"""Maximum size of a tokenizer file in bytes."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Checkpoint of one or several files."""

    name: str
    """File name, or the common part of several."""
    files: tuple[Path, ...]
    tensors: Mapping[str, Tensor]

    @property
    def path(self) -> Path:
        """Path of this checkpoint alone: its file, index or folder, or the first of its files."""
        if len(self.files) == 1:
            return self.files[0]
        index = self.files[0].with_name(f"{self.name}{INDEX}")
        if index.exists():
            return index
        folder = self.files[0].parent
        return folder if _checkpoint_files(folder) == set(self.files) else self.files[0]

    @property
    def bytes(self) -> int:
        """Size of all tensors in bytes."""
        return sum(math.prod(t.shape) * t.dtype.itemsize for t in self.tensors.values())


def sources(path: Path) -> Iterator[Source]:
    """Yield the checkpoints of a file, an index or a folder; subfolders are not searched.

    Files of one index, or numbered `NAME-00001-of-00003`, are one checkpoint; any of the numbered
    ones names it, if all are there. Raises `InputError` if a file is damaged or missing, or if two
    files of a checkpoint have the same tensor.
    """
    if path.name.endswith(INDEX):
        yield _of_index(path)
        return
    if not path.is_dir():
        yield _joined(*_numbered(path))
        return
    left = _checkpoint_files(path)
    for index in sorted(path.glob(f"*{INDEX}")):
        source = _of_index(index)
        left -= set(source.files)
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


def _checkpoint_files(folder: Path) -> set[Path]:
    """Return the files of a folder that hold tensors, by their suffix; no incomplete ones."""
    files = (f for f in folder.iterdir() if f.suffix in (".safetensors", *SUFFIXES) and f.is_file())
    return {file for file in files if not file.name.startswith(".")}


def _numbered(file: Path) -> tuple[str, list[Path]]:
    """Return the name and the files of the checkpoint that a numbered file names, or of the file.

    A numbered file is read alone if others of its checkpoint are missing.
    """
    if part := SHARD.fullmatch(file.stem):
        count = int(part[2])
        files = [
            file.with_name(f"{part[1]}-{number:05d}-of-{part[2]}{file.suffix}")
            for number in range(1, min(count, MAX_FILES) + 1)
        ]
        if file in files and len(files) == count and all(map(Path.is_file, files)):
            return quote_path(part[1]), files
    return quote_path(file.name), [file]


def _of_index(index: Path) -> Source:
    """Return the checkpoint of an index. Raises `InputError` if its files lack a tensor."""
    weight_map = _indexed(index)
    files = sorted({index.parent / name for name in weight_map.values()})
    source = _joined(quote_path(index.name.removesuffix(INDEX)), files)
    if lost := {WRAPPER.sub("", name) for name in weight_map} - source.tensors.keys():
        raise InputError(
            f"{quote_path(index)} lists {len(lost)} tensors that its files lack, such as "
            f"{quote(min(lost))}: the files are not of the same download."
        )
    return source


def _indexed(index: Path) -> dict[str, str]:
    """Return the file name of each tensor; every file exists next to the index."""
    match read_json(index):
        case {"weight_map": dict(weight_map)} if weight_map:
            pass
        case _:
            raise InputError(
                f"{quote_path(index)} is not a safetensors index: it has no weight_map."
            )
    for kind in set(map(type, weight_map.values())) - {str}:
        raise InputError(f"{quote_path(index)} has a {kind.__name__} where a file is expected.")
    siblings = set(os.listdir(index.parent))
    for name in sorted(set(weight_map.values())):
        if name not in siblings or not name.endswith(".safetensors"):
            raise InputError(
                f"{quote_path(index)} names {quote(name)}, not a safetensors file next to it."
            )
    return weight_map


def _read(file: Path) -> Mapping[str, Tensor]:
    """Return the tensors of a file, by its first bytes and not by its suffix."""
    start = b""
    if file.is_file():  # the reader refuses others
        with file.open("rb") as opened:
            start = opened.read(9)
    if start.startswith(b"GGUF"):
        raise InputError(
            f"{quote_path(file)} is a GGUF file, whose weights are rounded: give the .safetensors "
            "or .pth file that it was made from."
        )
    if start[8:] != b"{" and start.startswith((b"PK", b"\x80")):  # a zip, or a pickle
        return read_pth(file)
    return read_safetensors(file)


def _joined(name: str, files: Sequence[Path]) -> Source:
    tensors: dict[str, Tensor] = {}
    for file in files:
        read = _read(file)
        found = {WRAPPER.sub("", name): tensor for name, tensor in read.items()}
        if len(found) < len(read):
            raise InputError(
                f"{quote_path(file)} has the same tensors twice, with and without a wrapper such "
                "as _orig_mod: save only one state dict."
            )
        if duplicates := tensors.keys() & found.keys():
            raise InputError(
                f"{quote_path(file)} has {quote(min(duplicates))}, which another file of {name} "
                "also has."
            )
        tensors |= found
    return Source(name=name, files=tuple(files), tensors=tensors)


def tokenizer_files(folder: Path, *, within: Path) -> dict[str, bytes]:
    """Read the files of a tokenizer. Raises `InputError` for symlinks, which may point anywhere."""
    files = [folder / name for name in TOKENIZER_FILES if os.path.lexists(folder / name)]
    inner = [path for path in (folder, *folder.parents) if within in path.parents]
    for path in (*inner, *files):
        if path.is_symlink():
            raise InputError(
                f"{quote_path(path)} is a symlink; a tokenizer must not have symlinks. Copy the "
                "checkpoint folder with `cp -rL` if you trust the targets of its links."
            )
    return {file.name: read_bytes(file, limit=MAX_TOKENIZER) for file in files}
