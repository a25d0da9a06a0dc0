"""Triplet shards: ArrayRecord files of named arrays, and the manifest that describes them.

A folder holds `manifest.json` and `shard-00000.array_record`, ... A record is the bytes of a
safetensors file whose header carries the record's metadata as JSON. Three kinds of records:

    kind      arrays
    videos    target, prior, hands, mask, first_frame: bytes of the source's own files (uint8 "n")
    frames    the same, decoded at the manifest's spec: uint8 "f h w 3", mask "f h w", image "h w 3"
    latents   what a training step reads: latents "f h w 16", packed mask "f h w 4", embeddings, ...

All records of a folder hold the same arrays. A folder is written beside its place and put there in
one step, so it is whole or is not there. Reading trusts nothing: the manifest carries its own
SHA-256, file names are matched against a pattern, sizes are held against the manifest at opening,
ArrayRecord's hashes are verified on every read, and `check` verifies the files' SHA-256 and decodes
every record.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, get_args

import numpy as np
import safetensors
import safetensors.numpy
from array_record.python.array_record_data_source import ArrayRecordDataSource
from array_record.python.array_record_module import ArrayRecordWriter

from egosim_jax.io.atomic import LOCK, atomic_folder
from egosim_jax.io.digest import sha256
from egosim_jax.io.mapped import CODES
from egosim_jax.io.run import plain, write_json
from egosim_jax.io.untrusted import listing, parse_json, quote, quote_path, quote_text, read_json
from egosim_jax.types import InputError, VideoSpec

Kind = Literal["videos", "frames", "latents"]

VERSION = 1
MANIFEST = "manifest.json"
SEAL = "manifest_sha256"
"""In the manifest: the hash of all the rest of it."""
SHARD_NAME = re.compile(r"shard-\d{5}\.array_record")
_OPTIONS = "group_size:1,uncompressed"
_DTYPES = {code: CODES[code] for code in ("BOOL", "U8", "I32", "I64", "F16", "BF16", "F32")}
_DTYPE_NAMES = {dtype.name for dtype in _DTYPES.values()}


class RecordError(InputError):
    """A record cannot be read; the message names the file."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """One clip, or one window of a clip."""

    arrays: Mapping[str, np.ndarray]
    """Read-only arrays by name."""
    metadata: Mapping[str, Any]
    """`video_id`, `prompt`, `extra` and whatever the writer added; JSON values."""


@dataclass(frozen=True, kw_only=True)
class ArrayInfo:
    """What all records have in common in one array."""

    dtype: str
    shape: tuple[int | None, ...]
    """None where records differ."""


@dataclass(frozen=True, kw_only=True)
class ShardInfo:
    """One file of records."""

    file: str
    records: int
    size: int
    """Bytes."""
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The description of a folder of shards."""

    version: int = VERSION
    kind: Kind
    spec: VideoSpec | None
    """Length and size of the decoded frames or of what the latents encode; None for videos."""
    arrays: Mapping[str, ArrayInfo]
    shards: tuple[ShardInfo, ...]
    provenance: Mapping[str, Any]
    """Where the records come from: config, hashes of the encoders' weights, ..."""

    @property
    def records(self) -> int:
        """Records in all."""
        return sum(shard.records for shard in self.shards)

    @property
    def fingerprint(self) -> str:
        """SHA-256 over the shards' own: equal if and only if the records are."""
        return hashlib.sha256("".join(shard.sha256 for shard in self.shards).encode()).hexdigest()


def to_bytes(record: Record) -> bytes:
    """Serialize a record; `from_bytes` gives back equal arrays, bit for bit."""
    arrays = {name: np.ascontiguousarray(array) for name, array in record.arrays.items()}
    return safetensors.numpy.save(arrays, metadata={"json": json.dumps(dict(record.metadata))})


def from_bytes(data: bytes, *, name: str = "the record") -> Record:
    """Parse the bytes of a record. Raises `RecordError` if they are not one."""
    try:
        arrays = {
            _current_name(key): np.frombuffer(tensor["data"], _DTYPES[tensor["dtype"]]).reshape(
                tensor["shape"]
            )
            # It gives them in any order.
            for key, tensor in sorted(safetensors.deserialize(data), key=lambda pair: pair[0])
        }
        length = int.from_bytes(data[:8], "little")
        header = parse_json(data[8 : 8 + length], source="its header")
        metadata = parse_json(header["__metadata__"]["json"].encode(), source="its metadata")
        texts = {key: metadata.get(key, "") for key in ("video_id", "prompt")}
        extra = metadata.get("extra", {})
        if not all(isinstance(text, str) for text in [*texts.values(), *extra.values()]):
            raise TypeError("its id, prompt and further columns must be text")
    except (safetensors.SafetensorError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise RecordError(f"{name} is not a record of arrays: {quote_text(str(error))}.") from error
    return Record(arrays=arrays, metadata=metadata)


def _current_name(key: str) -> str:
    """Return today's name of an array; earlier datasets call the target `truth`."""
    return "target" if key == "truth" else key


class ShardWriter(AbstractContextManager["ShardWriter"]):
    """Write a folder of shards in a `with` block, or nothing if it ends by an exception.

    An existing dataset is replaced only with `overwrite`, in one step, once the new one is
    complete. Raises `InputError` if the folder holds a dataset or other files, or if records
    disagree in their arrays.
    """

    def __init__(
        self,
        folder: Path,
        *,
        kind: Kind,
        spec: VideoSpec | None = None,
        provenance: Mapping[str, Any] | None = None,
        shard_bytes: int = 256 * 2**20,
        overwrite: bool = False,
    ):
        _check_place(folder, overwrite)
        self.folder = folder
        self.kind: Kind = kind
        self.spec = spec
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
        """Append a record; a full shard is closed first."""
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
                with suppress(RuntimeError):  # what could not be written is thrown away anyway
                    self._writer.close()
            self._place.__exit__(kind, error, trace)
            return
        with self._place:
            self._finish_shard()
            if not self._shards:
                raise InputError(f"No record was written to {self.folder}.")
            _write_manifest(
                self._temporary,
                Manifest(
                    kind=self.kind,
                    spec=self.spec,
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
        """Merge a record's shapes into the manifest's."""
        for key, array in arrays.items():
            if array.dtype not in _DTYPES.values():
                raise InputError(f"{name}: {key} is {array.dtype}, which no record can hold.")
        infos = {
            key: ArrayInfo(dtype=array.dtype.name, shape=array.shape)
            for key, array in arrays.items()
        }
        self._arrays = _merge(self._arrays, infos, name)


def _check_place(folder: Path, overwrite: bool) -> None:
    """Raise `InputError` if there is anything in a folder that must not be replaced."""
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


def _write_manifest(folder: Path, manifest: Manifest) -> None:
    fields = plain(dataclasses.asdict(manifest))
    write_json(folder / MANIFEST, {**fields, SEAL: _sealed(fields)})


def _sealed(fields: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def _merge(
    before: Mapping[str, ArrayInfo], arrays: Mapping[str, ArrayInfo], name: str
) -> dict[str, ArrayInfo]:
    """What two descriptions have in common; axes on which they differ become None."""
    if before and arrays.keys() != before.keys():
        raise InputError(
            f"{name} holds {sorted(arrays)}, but the records before it hold {sorted(before)}."
        )
    merged = {}
    for key, info in arrays.items():
        want = before.get(key, info)
        if info.dtype != want.dtype:
            raise InputError(f"{name}: {key} is {info.dtype}, wanted {want.dtype}.")
        if len(info.shape) != len(want.shape):
            raise InputError(f"{name}: {key} is {info.shape}, wanted {want.shape}.")
        axes = zip(want.shape, info.shape, strict=True)
        shape = tuple(a if a == b else None for a, b in axes)
        merged[key] = ArrayInfo(dtype=info.dtype, shape=shape)
    return merged


def gather(parts: Sequence[Path], out: Path) -> Manifest:
    """Make one folder of shards of several, in this order, by renaming; the manifest comes last.

    All parts were written with the same kind, spec and provenance. After an interruption the same
    call goes on. Raises `InputError` naming the parts that are not there, and the shards that are
    not as their part's manifest says.
    """
    missing = [part.name for part in parts if not (part / MANIFEST).exists()]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(parts)} parts are not in {parts[0].parent}: "
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
        raise InputError(f"{out} cannot be put together: {listing(problems)}.")
    manifest = dataclasses.replace(read_manifest(parts[0]), arrays=arrays, shards=tuple(shards))
    _write_manifest(out, manifest)
    return manifest


class ShardReader:
    """Random access to the records of a folder: `len(reader)`, `reader[i]`.

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
            raise InputError(f"{folder} is not as its manifest says: {listing(problems)}.")
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
        """File and position of a record, for messages."""
        for shard in self.manifest.shards:
            if index < shard.records:
                return f"{self.folder / shard.file}, record {index}"
            index -= shard.records
        raise IndexError(f"{self.folder} has no such record")


def read_manifest(folder: Path) -> Manifest:
    """Read and validate a folder's manifest. Raises `InputError` if there is none, or a bad one."""
    path = folder / MANIFEST
    if not path.is_file():
        raise InputError(f"{quote_path(folder)} holds no dataset: there is no {MANIFEST}.")
    fields = read_json(path)
    name = quote_path(path)
    try:
        manifest = _manifest(fields, name)
    except InputError:
        raise
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        reason = quote_text(f"{type(error).__name__}: {error}")
        raise InputError(f"{name} is not a manifest of shards: {reason}.") from error
    sealed = fields.pop(SEAL, None)  # earlier versions have none
    if sealed not in (None, _sealed(fields)):
        raise InputError(f"{name} was changed after it was written. Take another copy.")
    return manifest


def _manifest(fields: Any, name: str) -> Manifest:
    """Build a manifest from JSON. Raises `InputError`, or what a wrong type leads to."""
    version, kind, spec = fields["version"], fields["kind"], fields["spec"]
    if type(version) is not int or version != VERSION or kind not in get_args(Kind):
        raise InputError(
            f"{name} has version {quote(version)} and kind {quote(kind)}; this program reads "
            f"version {VERSION} and kinds {', '.join(get_args(Kind))}."
        )
    shards = tuple(ShardInfo(**shard) for shard in fields["shards"])
    for shard in shards:
        if not (isinstance(shard.file, str) and isinstance(shard.sha256, str)):
            raise TypeError("a shard without file or sha256")
        if not (type(shard.size) is type(shard.records) is int and shard.size < 1 << 48):
            raise TypeError("a shard whose size or number of records is no count")
    unsafe = [quote(shard.file) for shard in shards if not SHARD_NAME.fullmatch(shard.file)]
    files = {shard.file for shard in shards}
    if unsafe or len(files) < max(1, len(shards)) or any(shard.records < 1 for shard in shards):
        raise InputError(
            f"{name} must name different shards like shard-00000.array_record of at least one "
            f"record, not {', '.join(unsafe[:8]) or 'none, equal or empty ones'}."
        )
    arrays = {
        _current_name(key): ArrayInfo(dtype=info["dtype"], shape=tuple(info["shape"]))
        for key, info in fields["arrays"].items()
    }
    axes = [axis for info in arrays.values() for axis in info.shape]
    if any(axis is not None and (type(axis) is not int or axis < 0) for axis in axes):
        raise TypeError("a shape that is none")
    if any(info.dtype not in _DTYPE_NAMES for info in arrays.values()):
        raise TypeError("a dtype that no record can hold")
    if spec is not None and not all(type(value) is int for value in spec.values()):
        raise TypeError("a spec that is not whole numbers")
    return Manifest(
        kind=kind,
        spec=None if spec is None else VideoSpec(**spec),
        arrays=arrays,
        shards=shards,
        provenance=dict(fields["provenance"].items()),
    )


def file_problems(folder: Path, shard: ShardInfo) -> list[str]:
    """What differs between a shard and the manifest, without reading it."""
    path = folder / shard.file
    if not path.is_file() or path.is_symlink():
        return [f"{path}: missing"]
    size = path.stat().st_size
    return [] if size == shard.size else [f"{path}: {size} bytes, the manifest says {shard.size}"]
