"""A zip archive is refused before anything that it expands to is allocated, by every reader."""

import io
import struct
import tempfile
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.data.readers.record3d import Record3D
from egosim_jax.io.untrusted.npz import array_names, read_arrays
from egosim_jax.io.untrusted.pth import read_pth
from egosim_jax.io.untrusted.zipped import from_file
from egosim_jax.perception.recorded import _unpack
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import InputError

SIZE = 1 << 20


def zipped(entries, method=zipfile.ZIP_STORED):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", method) as file:
        for name, content in entries:
            file.writestr(name, content)
    return data.getvalue()


def field(data, offset, value, *, entry=0, form="<I"):
    """Change a field of an entry in the central directory."""
    at = -1
    for _ in range(entry + 1):
        at = data.index(b"PK\1\2", at + 1)
    at += offset
    return data[:at] + struct.pack(form, value) + data[at + struct.calcsize(form) :]


def overlapping(names):
    """Many entries with the bytes of the first one."""
    data = zipped([(names[0], bytes(SIZE)), *((name, b"") for name in names[1:])])
    for number in range(1, len(names)):
        for offset in (20, 24):
            data = field(data, offset, SIZE, entry=number)
        data = field(data, 42, 0, entry=number)
        data = field(data, 16, zlib.crc32(bytes(SIZE)), entry=number)
    return data


def nested(names):
    """A second entry inside the content of the first one."""
    inner = zipped([(names[1], bytes(1000))])
    data = zipped([(names[0], inner), (names[1], bytes(1000))])
    return field(data, 42, 30 + len(names[0]), entry=1)


def grown(names):
    """Compressed, and larger than declared: 64 MiB as 100 bytes."""
    data = zipped([(names[0], bytes(64 * SIZE)), (names[1], b"1")], zipfile.ZIP_DEFLATED)
    return field(data, 24, 100)


def counted(names):
    """A directory that declares a million entries."""
    data = zipped([(name, b"1") for name in names])
    end = data.index(b"PK\5\6")
    locator = struct.pack("<4sIQI", b"PK\6\7", 0, end, 1)
    record = struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 45, 45, 0, 0, 1 << 20, 1 << 20, 0, 0)
    return data[:end] + record + locator + data[end:]


BAD = {
    "overlapping": overlapping,
    "nested": nested,
    "grown": grown,
    "million entries": counted,
    "method": lambda names: zipped([(n, bytes(SIZE)) for n in names], zipfile.ZIP_LZMA),
    "encrypted": lambda names: field(zipped([(n, b"1") for n in names]), 8, 1, form="<H"),
    "beyond the end": lambda names: field(zipped([(n, b"1") for n in names]), 42, 1 << 30),
}


def read_episode(path: Path):
    Episode.from_bytes(path.read_bytes())


def read_capture(path: Path):
    (entry,) = Record3D(source=path).find()
    entry.read(path.parent)


def read_npz(path: Path):
    read_arrays(path, {}, others=("a", "b", "c"), packed=True)


READERS = {
    "episode": (read_episode, "x.zip", [f"clip_{n}/action.npz" for n in (1, 2, 3)]),
    "npz": (read_npz, "x.npz", ["a.npy", "b.npy", "c.npy"]),
    "record3d": (read_capture, "x.r3d", ["metadata", "rgbd/0.jpg", "rgbd/1.jpg"]),
    "recorded": (lambda path: list(_unpack(path, 5)), "x.zip", ["0.png", "1.png", "2.png"]),
    "torch": (read_pth, "x.pth", ["a/data.pkl", "a/data/0", "a/data/1"]),
}


PAIRS = [("npz", kind) for kind in BAD] + [
    (reader, kind)
    for reader, kinds in zip(READERS, (("grown",), (), ("nested", "overlapping")) * 2, strict=False)
    for kind in kinds
]


@pytest.mark.parametrize(("reader", "kind"), PAIRS)
def test_an_archive_that_expands_is_refused_before_it_is_unpacked(tmp_path, reader, kind):
    read, name, names = READERS[reader]
    (tmp_path / name).write_bytes(BAD[kind](names))
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as error:
            read(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 16 * SIZE
    finally:
        tracemalloc.stop()
    assert str(error.value).isprintable()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_an_archive_of_the_standard_library_is_read(method):
    entries = [("a", b""), ("ü/b", bytes(range(256)) * 40), ("c", b"x")]
    archive = from_file(io.BytesIO(zipped(entries, method)))
    assert [(name, archive.read(name)) for name in archive.entries] == entries


def test_compressed_arrays_are_bounded_together(tmp_path):
    arrays = {name: np.zeros(7 * SIZE) for name in "abcde"}
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    assert (tmp_path / "x.npz").stat().st_size < SIZE
    with pytest.raises(InputError, match="compressed or too large"):
        read_arrays(tmp_path / "x.npz", {}, others=array_names(tmp_path / "x.npz"), packed=True)


def test_an_episode_says_nothing_of_the_folder_in_which_it_is_read():
    data = zipped([("episode.json", b"{"), ("state/state.json", b"{")])
    for content in (data, zipped([("state/state.json", b"{}")]), zipped([])):
        with pytest.raises(InputError) as error:
            Episode.from_bytes(content)
        assert tempfile.gettempdir() not in str(error.value)
