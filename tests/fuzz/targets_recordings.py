"""Fuzzing targets: recordings, and what readers of datasets read of others."""

from __future__ import annotations

import contextlib
import io
import struct
import zlib
from fractions import Fraction
from pathlib import Path
from random import Random
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from egosim_jax.data.readers.record3d import unpacked_size
from egosim_jax.data.recording import Recording
from egosim_jax.data.scene_points import ScenePoints
from egosim_jax.io.untrusted import hdf5, isolated, parquet
from egosim_jax.io.untrusted.colmap import read_model
from egosim_jax.types import InputError
from tests.fuzz.target import Target

isolated.TIMEOUT_S, isolated.MAX_CPU_S = 60.0, 5.0  # a disk that is busy takes no processor time

COLUMNS = {"episode_index": [0, 1], "length": [7, 5], "tasks": [["pick"], ["place", "wait"]]}
NO_CHECKSUM = "The format has no checksum: another number is as good as the one before."


def make_recording(folder: Path) -> None:
    """Write a recording with poses, hands and points."""
    rng = np.random.default_rng(0)
    Recording(
        recording_id="fold_1",
        video=folder / "video.mp4",
        frames=3,
        fps=Fraction(30),
        height=48,
        width=64,
        world_from_camera=np.tile(np.eye(4), (3, 1, 1)),
        intrinsics_px=np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]),
        metric=True,
        joints_m=np.tile(rng.uniform(-0.05, 0.05, (21, 3)) + [0, 0, 0.5], (3, 2, 1, 1)),
        points=ScenePoints(points_m=rng.normal(size=(5, 3)).astype(np.float32)),
        caption="Fold it.",
    ).save(folder)


def read_recording(folder: Path) -> Any:
    """Load it; its arrays, which are sealed."""
    recording = Recording.load(folder)
    points = None if recording.points is None else recording.points.points_m
    return recording.world_from_camera, recording.intrinsics_px, recording.joints_m, points


def make_hdf5(folder: Path) -> None:
    """Write arrays as they are and packed, and attributes."""
    with h5py.File(folder / "a.h5", "w") as file:
        file["camera/intrinsic"] = np.eye(3, dtype=np.float32)
        poses = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
        file.create_dataset("transforms/camera", data=poses, compression="gzip", fletcher32=True)
        file.attrs["llm_objects"] = ["towel", "table"]


def read_hdf5(folder: Path) -> Any:
    """Read the arrays and texts."""
    shapes = {"camera/intrinsic": (3, 3), "transforms/camera": (None, 4, 4)}
    found = hdf5.read_hdf5(folder / "a.h5", shapes, texts=["llm_objects"])
    return dict(found.arrays), dict(found.texts)


def make_parquet(folder: Path) -> None:
    """Write a table with numbers and lists of texts."""
    pq.write_table(pa.table(COLUMNS), folder / "a.parquet")


def read_parquet(folder: Path) -> Any:
    """Read its columns."""
    return parquet.read_parquet(folder / "a.parquet", list(COLUMNS))


def make_colmap(folder: Path) -> None:
    """Write one image and one point in both formats."""
    binary, text = folder / "binary", folder / "text"
    binary.mkdir()
    text.mkdir()
    pose, camera = [1.0, 0, 0, 0, 0.1, 0.2, 0.3], [60.0, 60.0, 32.0, 24.0]
    (binary / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 64, 48, *camera))
    image = struct.pack("<QI7dI", 1, 1, *pose, 1) + b"a.png\0"
    (binary / "images.bin").write_bytes(image + struct.pack("<Qddq", 1, 5.0, 6.0, 9))
    point = struct.pack("<QQ3d3Bd", 1, 9, 0.5, 0.5, 2.0, 1, 2, 3, 0.4)
    (binary / "points3D.bin").write_bytes(point + struct.pack("<QII", 1, 1, 0))
    (text / "cameras.txt").write_text("# cameras\n1 PINHOLE 64 48 60 60 32 24\n")
    (text / "images.txt").write_text("1 1 0 0 0 0.1 0.2 0.3 1 a.png\n5 6 9\n")
    (text / "points3D.txt").write_text("9 0.5 0.5 2 1 2 3 0.4 1 0\n")


def read_colmap(folder: Path) -> Any:
    """Read both."""
    models = [read_model(folder / name) for name in ("binary", "text")]
    return [(m.points, [i.camera_from_world for i in m.images]) for m in models]


def make_lzfse(folder: Path) -> None:
    """Write a stream of two blocks."""
    stored = b"bvx-" + struct.pack("<I", 4) + b"abcd"
    (folder / "a.depth").write_bytes(stored + b"bvxn" + struct.pack("<II", 9, 3) + b"xyzbvx$")


def read_lzfse(folder: Path) -> Any:
    """Add up the sizes of its blocks."""
    try:
        return min(unpacked_size((folder / "a.depth").read_bytes()), 1 << 33)
    except ValueError as error:
        raise InputError(str(error)) from error


FILLS: tuple[Any, ...] = (0, 1, float("nan"), float("inf"), -1e308)
SIZES = (0, 1, 3, 1 << 10, 1 << 18, 1 << 22, 1 << 40)


def other_hdf5(data: bytes, random: Random) -> bytes:
    """Write datasets of other shapes, kinds, chunks and filters, mostly of fill values."""
    file = io.BytesIO()
    with contextlib.suppress(Exception), h5py.File(file, "w") as written:
        for name, shape in (("camera/intrinsic", (3, 3)), ("transforms/camera", (3, 4, 4))):
            shape = random.choice((shape, (random.choice(SIZES), *shape[1:]), shape[1:]))
            options: dict[str, Any] = {"fillvalue": random.choice(FILLS)}
            if random.random() < 0.5:
                options["chunks"] = tuple(random.choice((1, 4, 1 << 12)) for _ in shape)
                options["maxshape"] = (None,) * len(shape)
                options["compression"] = random.choice((None, "gzip", "lzf"))
            kind = random.choice(("f4", "f8", "i1", "u8", "S9", "f2", h5py.string_dtype()))
            dataset = written.create_dataset(name, shape, kind, **options)
            if options.get("compression") == "gzip" and random.random() < 0.5:
                bomb = zlib.compress(bytes(random.choice((9, 10**6, 10**8))))
                dataset.id.write_direct_chunk((0,) * len(shape), bomb)
        link = random.choice((h5py.SoftLink("/x"), h5py.ExternalLink("/etc/passwd", "/x"), None))
        if link is not None:
            del written["camera/intrinsic"]
            written["camera/intrinsic"] = link
        texts = random.choice(("a", ["a"] * random.choice((1, 5000)), 3, [b"\xff", b"b"]))
        written.attrs["llm_objects"] = texts
    return file.getvalue()


def other_parquet(data: bytes, random: Random) -> bytes:
    """Write columns of other kinds and encodings, mostly of equal values."""
    file, rows = io.BytesIO(), random.choice((0, 1, 1000, 1 << 17, 1 << 20))
    text, index = "x" * random.choice((1, 100, 1 << 20)), np.zeros(rows, np.int8)
    kinds = (
        lambda: pa.DictionaryArray.from_arrays(index, [text]),
        lambda: pa.DictionaryArray.from_arrays(index, pa.array([[text] * 9])),
        lambda: pa.array(np.full(rows, random.choice(FILLS))),
        lambda: pa.nulls(rows, pa.list_(pa.float32())),
        lambda: pa.array(np.zeros(rows, "M8[ns]")),
        lambda: pa.array([{"a": [{"b": 1}] * 9}] * min(rows, 100_000)),
    )
    with contextlib.suppress(pa.ArrowException, ValueError):
        columns = {name: random.choice(kinds)() for name in COLUMNS}
        size = min(len(column) for column in columns.values())
        table = pa.table({name: column.slice(0, size) for name, column in columns.items()})
        packing = random.choice(("none", "snappy", "gzip", "zstd", "brotli"))
        pq.write_table(table, file, compression=packing, store_schema=random.random() < 0.5)
    return file.getvalue()


TARGETS: list[Target] = [
    Target(
        name="recording",
        make=make_recording,
        read=read_recording,
        files=("recording.json", "arrays.npz"),
        sealed=True,
    ),
    Target(
        name="hdf5",
        make=make_hdf5,
        read=read_hdf5,
        files=("*.h5",),
        lossy=NO_CHECKSUM,
        mutations=(other_hdf5,) * 4,
    ),
    Target(
        name="parquet",
        make=make_parquet,
        read=read_parquet,
        files=("*.parquet",),
        lossy=NO_CHECKSUM,
        mutations=(other_parquet,) * 4,
    ),
    Target(name="colmap", make=make_colmap, read=read_colmap, files=("*/*",), lossy=NO_CHECKSUM),
    Target(name="lzfse", make=make_lzfse, read=read_lzfse, files=("a.depth",), lossy=NO_CHECKSUM),
]
