"""Triplet shards: ArrayRecord files of named arrays, and the manifest that describes them.

A folder holds `manifest.json` and `shard-00000.array_record`, ... There are three kinds of records:

    kind      arrays
    videos    target, prior, hands, mask, first_frame: bytes of the source files (uint8 "n")
    frames    the same, decoded at the manifest's spec: uint8 "f h w 3", mask "f h w", image "h w 3"
    latents   inputs of a training step: latents "f h w c", packed mask "f h w m", embeddings, ...

All records of a folder hold the same arrays. A folder is written next to its destination and
renamed in one step, so it is complete or absent. Reading trusts nothing. The manifest is validated,
file sizes are compared with it at opening, and ArrayRecord verifies its own hashes on every read.
`check` also verifies the SHA-256 of the files and decodes every record.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from array_record.python.array_record_data_source import ArrayRecordDataSource
from array_record.python.array_record_module import ArrayRecordWriter

from egosim_jax.data.manifest import (
    MANIFEST,
    SHARD_NAME,
    ArrayInfo,
    Manifest,
    RecordKind,
    ShardInfo,
    file_problems,
    read_manifest,
    write_manifest,
)
from egosim_jax.data.records import DTYPES, Record, RecordError, from_bytes, to_bytes
from egosim_jax.io.atomic import LOCK, atomic_folder
from egosim_jax.io.bounded import listing, quote_text
from egosim_jax.io.digest import sha256
from egosim_jax.types import WAN_GRID, InputError, VideoGrid, VideoSpec

_OPTIONS = "group_size:1,uncompressed"


class ShardWriter(AbstractContextManager["ShardWriter"]):
    """A context manager that writes a folder of shards; an exception leaves no folder.

    An existing dataset is replaced only with `overwrite`, in one step, once the new one is
    complete. Raises `InputError` if the folder holds a dataset or other files, or if records
    disagree in their arrays.
    """

    def __init__(
        self,
        folder: Path,
        *,
        kind: RecordKind,
        spec: VideoSpec | None = None,
        grid: VideoGrid = WAN_GRID,
        provenance: Mapping[str, Any] | None = None,
        shard_bytes: int = 256 * 2**20,
        overwrite: bool = False,
    ):
        _check_place(folder, overwrite)
        self.folder = folder
        self.kind: RecordKind = kind
        self.spec, self.grid = spec, grid
        self.provenance = dict(provenance or {})
        self.shard_bytes = shard_bytes
        self._place = ExitStack()
        self._arrays: dict[str, ArrayInfo] = {}
        self._shards: list[ShardInfo] = []
        self._writer: ArrayRecordWriter | None = None
        self._records = self._bytes = 0

    def __enter__(self) -> ShardWriter:
        self._temporary = self._place.enter_context(atomic_folder(self.folder.resolve()))
        return self

    def add(self, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, Any]) -> None:
        """Append a record; start another shard if this one would exceed `shard_bytes`."""
        self._note(arrays, str(metadata.get("video_id", "a record")))
        data = to_bytes(Record(arrays=arrays, metadata=metadata))
        if self._bytes + len(data) > self.shard_bytes:
            self._finish_shard()
        writer = self._writer or ArrayRecordWriter(str(self._shard_path()), _OPTIONS)
        self._writer = writer
        writer.write(data)
        self._records += 1
        self._bytes += len(data)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None:
            if self._writer is not None:
                with suppress(RuntimeError):  # the shard is discarded anyway
                    self._writer.close()
            self._place.__exit__(kind, error, trace)
            return
        with self._place:
            self._finish_shard()
            if not self._shards:
                raise InputError(f"No record was written to {self.folder}.")
            write_manifest(
                self._temporary,
                Manifest(
                    kind=self.kind,
                    spec=self.spec,
                    grid=self.grid,
                    arrays=self._arrays,
                    shards=tuple(self._shards),
                    provenance=self.provenance,
                ),
            )

    def _shard_path(self) -> Path:
        return self._temporary / f"shard-{len(self._shards):05d}.array_record"

    def _finish_shard(self) -> None:
        if self._writer is None:
            return
        self._writer.close()
        path = self._shard_path()
        self._shards.append(
            ShardInfo(
                file=path.name,
                records=self._records,
                size=path.stat().st_size,
                sha256=sha256(path),
            )
        )
        self._writer, self._records, self._bytes = None, 0, 0

    def _note(self, arrays: Mapping[str, np.ndarray], name: str) -> None:
        """Merge the shapes of a record into the manifest's shapes."""
        for key, array in arrays.items():
            if array.dtype.name not in DTYPES:
                raise InputError(
                    f"{name}: {key} has dtype {array.dtype}; records hold {', '.join(DTYPES)}."
                )
        infos = {
            key: ArrayInfo(dtype=array.dtype.name, shape=array.shape)
            for key, array in arrays.items()
        }
        self._arrays = _merge(self._arrays, infos, name)


def _check_place(folder: Path, overwrite: bool) -> None:
    """Raise `InputError` if a folder holds files that must not be replaced."""
    try:
        names = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    except OSError as error:
        raise InputError(f"Cannot write to {folder}: {error.strerror}. (--out)") from error
    if MANIFEST in names and not overwrite:
        raise InputError(f"{folder} already holds shards. (--overwrite replaces them)")
    ours = {MANIFEST, LOCK}
    others = [n for n in names if n not in ours and not SHARD_NAME.fullmatch(n.split(".tmp")[0])]
    if others:
        raise InputError(
            f"{folder} holds other files, such as {quote_text(others[0])}, which would be lost. "
            "Choose a new or an empty folder. (--out)"
        )


def _merge(
    before: Mapping[str, ArrayInfo], arrays: Mapping[str, ArrayInfo], name: str
) -> dict[str, ArrayInfo]:
    """Merge two descriptions of arrays; axes on which they differ become None."""
    if before and arrays.keys() != before.keys():
        raise InputError(
            f"{name} holds the arrays {sorted(arrays)}; expected {sorted(before)}, as in the "
            "records before it."
        )
    merged = {}
    for key, info in arrays.items():
        want = before.get(key, info)
        if info.dtype != want.dtype:
            raise InputError(f"{name}: {key} has dtype {info.dtype}; expected {want.dtype}.")
        if len(info.shape) != len(want.shape):
            raise InputError(f"{name}: {key} has shape {info.shape}; expected {want.shape}.")
        axes = zip(want.shape, info.shape, strict=True)
        shape = tuple(a if a == b else None for a, b in axes)
        merged[key] = ArrayInfo(dtype=info.dtype, shape=shape)
    return merged


def gather(
    parts: Sequence[Path], out: Path, *, provenance: Mapping[str, Any] | None = None
) -> Manifest:
    """Concatenate folders of shards into one by renaming their files; write its manifest last.

    All parts must have the same kind, spec and provenance; `provenance` is added. Calling again
    resumes an interrupted call. Raises `InputError` naming missing parts, and shards
    that differ from the manifest of their part.
    """
    missing = [part.name for part in parts if not (part / MANIFEST).exists()]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(parts)} parts are missing in {parts[0].parent}: "
            f"{', '.join(missing[:8])}. All processes must write to the same folder. (--out)"
        )
    arrays: dict[str, ArrayInfo] = {}
    shards: list[ShardInfo] = []
    problems = []
    for part in parts:
        manifest = read_manifest(part)
        arrays = _merge(arrays, manifest.arrays, str(part))
        for shard in manifest.shards:
            file = f"shard-{len(shards):05d}.array_record"
            shards.append(dataclasses.replace(shard, file=file))
            if (part / shard.file).exists():
                (part / shard.file).replace(out / file)
            for problem in file_problems(out, shards[-1]):
                problems.append(f"{problem}: remove {part} to write it again")
    if problems:
        raise InputError(f"{out} cannot be concatenated: {listing(problems)}.")
    manifest = read_manifest(parts[0])
    manifest = dataclasses.replace(
        manifest,
        arrays=arrays,
        shards=tuple(shards),
        provenance={**manifest.provenance, **(provenance or {})},
    )
    write_manifest(out, manifest)
    return manifest


class ShardReader:
    """A sequence of the records of a folder: `len(reader)`, `reader[i]`.

    Opening compares the folder with its manifest and raises `InputError` with every difference;
    reading raises `RecordError`. Readers can be pickled and shared by threads.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.manifest = read_manifest(folder)
        problems = []
        for shard in self.manifest.shards:
            problems += file_problems(folder, shard)
        if problems:
            raise InputError(f"{folder} differs from its manifest: {listing(problems)}.")
        self._source = ArrayRecordDataSource(
            [f"{folder / shard.file}[0:{shard.records}]" for shard in self.manifest.shards]
        )

    def __len__(self) -> int:
        return self.manifest.records

    def __getitem__(self, index: int) -> Record:
        if not 0 <= index < len(self):
            raise IndexError(f"record {index} of {len(self)}")
        name = self.name(index)
        try:
            data = self._source[index]
        except (RuntimeError, IndexError, ValueError) as error:
            raise RecordError(f"{name} cannot be read: {quote_text(str(error))}.") from error
        return from_bytes(data, name=name)

    def __iter__(self) -> Iterator[Record]:
        return (self[index] for index in range(len(self)))

    def name(self, index: int) -> str:
        """Return file and position of a record, for messages."""
        for shard in self.manifest.shards:
            if index < shard.records:
                return f"{self.folder / shard.file}, record {index}"
            index -= shard.records
        raise IndexError(f"{self.folder} has no such record")
