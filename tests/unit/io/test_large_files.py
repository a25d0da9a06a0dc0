"""Files of more than 4 GiB are read where their data are, behind a hole that takes no disk."""

import io
import struct
import tarfile

import av
import h5py
import numpy as np
import pytest

from egosim_jax.data.readers.hot3d import Hot3D
from egosim_jax.io.untrusted.hdf5 import read_hdf5
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.io.video import probe_video, read_video
from tests.captures import World
from tests.unit.data.readers.test_hot3d import FRAMES, write_clip

GAP = 5 << 30
PARENTS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")


def box(kind, content, *, gap=0, wide=False):
    """Return the bytes of an MP4 box, or those before the hole of `gap` bytes that it ends with."""
    size = 8 + 8 * wide + len(content) + gap
    head = struct.pack(">I4sQ", 1, kind, size) if wide else struct.pack(">I4s", size, kind)
    return head + content


def boxes(data):
    at = 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        yield data[at + 4 : at + 8], data[at + 8 : at + size]
        at += size


def moved(kind, content, shift):
    """Return a box whose 32-bit offsets of samples became 64-bit ones, moved by `shift`."""
    if kind in PARENTS:
        content = b"".join(moved(*inner, shift) for inner in boxes(content))
    if kind == b"stco":
        offsets = np.frombuffer(content[8:], ">u4").astype(">u8") + np.uint64(shift)
        kind, content = b"co64", content[:8] + offsets.astype(">u8").tobytes()
    return box(kind, content)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return World(frames=12).write_video(tmp_path_factory.mktemp("film") / "film.mp4")


def write_mp4(film, path):
    hole = box(b"free", b"", gap=GAP, wide=True)
    with path.open("wb") as file:
        for kind, content in boxes(film.read_bytes()):
            if kind == b"mdat":
                file.write(hole)
                file.seek(GAP, 1)
            wide = kind == b"mdat"
            shift = len(hole) + GAP + 8  # and the longer head of mdat
            file.write(
                moved(kind, content, shift) if kind == b"moov" else box(kind, content, wide=wide)
            )


def write_mkv(film, path):
    data = io.BytesIO()
    with av.open(str(film)) as source, av.open(data, "w", "matroska", {"live": "1"}) as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    first = data.getvalue().index(b"\x1f\x43\xb6\x75")  # the first cluster
    with path.open("wb") as file:
        file.write(data.getvalue()[:first])
        for _ in range(5):
            file.write(b"\xec\x01" + (GAP // 5).to_bytes(7, "big"))  # a void element
            file.seek(GAP // 5, 1)
        file.write(data.getvalue()[first:])


@pytest.mark.parametrize("write", [write_mp4, write_mkv])
def test_frames_beyond_4_gib_of_a_video_are_read(film, tmp_path, write):
    path = tmp_path / f"large.{write.__name__[-3:]}"
    write(film, path)
    assert path.stat().st_size > GAP
    expected = read_video(film).frames
    np.testing.assert_array_equal(read_video(path).frames, expected)
    assert probe_video(path).frames == len(expected)
    np.testing.assert_array_equal(read_video(path, start=5, stop=8).frames, expected[5:8])


@pytest.mark.parametrize("gap", [GAP, 9 << 30])  # a tar has 11 octal digits up to 8 GiB
def test_a_clip_beyond_4_gib_of_a_tar_is_read(tmp_path, gap):
    write_clip(tmp_path / "clip.tar")
    clip = (tmp_path / "clip.tar").read_bytes()
    info = tarfile.TarInfo("other.bin")
    info.size = gap
    with (tmp_path / "clip.tar").open("wb") as file:
        file.write(info.tobuf(tarfile.GNU_FORMAT))
        file.seek(gap, 1)
        file.write(clip)
    (entry,) = Hot3D(source=tmp_path).find()
    assert entry.read(tmp_path).frames == FRAMES


def test_a_dataset_beyond_4_gib_of_an_hdf5_file_is_read(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        space = h5py.h5s.create_simple((GAP,))
        h5py.h5d.create(file.id, b"images", h5py.h5t.NATIVE_UINT8, space, dcpl=layout)
        file["poses"] = np.arange(12.0).reshape(3, 4)
    assert (tmp_path / "x.h5").stat().st_size > GAP
    poses = read_hdf5(tmp_path / "x.h5", {"poses": (None, 4)}).arrays["poses"]
    np.testing.assert_array_equal(poses, np.arange(12.0).reshape(3, 4))


def test_arrays_beyond_4_gib_of_a_zip_are_read(tmp_path):
    values = np.arange(12.0).reshape(3, 4)
    with (tmp_path / "x.npz").open("wb") as file:
        file.seek(GAP)
        np.savez(file, a=values, b=values[0])
    found = read_arrays(tmp_path / "x.npz", {"a": "float64"}, others=("b",))
    np.testing.assert_array_equal(found["a"], values)
    np.testing.assert_array_equal(found["b"], values[0])
