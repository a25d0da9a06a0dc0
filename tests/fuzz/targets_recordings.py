"""Fuzzing targets: recordings, and what readers of datasets read of others."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from egosim_jax.data.readers.lzfse import unpacked_size
from egosim_jax.data.recording import Recording
from egosim_jax.data.scene_points import ScenePoints
from egosim_jax.io.untrusted import hdf5, isolated, parquet
from egosim_jax.io.untrusted.colmap import read_model
from egosim_jax.types import InputError
from tests.fuzz.target import Target

isolated.TIMEOUT_S = 5.0  # a case may take 20 s

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


TARGETS: list[Target] = [
    Target(
        name="recording",
        make=make_recording,
        read=read_recording,
        files=("recording.json", "arrays.npz"),
        sealed=True,
    ),
    Target(name="hdf5", make=make_hdf5, read=read_hdf5, files=("*.h5",), lossy=NO_CHECKSUM),
    Target(
        name="parquet",
        make=make_parquet,
        read=read_parquet,
        files=("*.parquet",),
        lossy=NO_CHECKSUM,
    ),
    Target(name="colmap", make=make_colmap, read=read_colmap, files=("*/*",), lossy=NO_CHECKSUM),
    Target(name="lzfse", make=make_lzfse, read=read_lzfse, files=("a.depth",), lossy=NO_CHECKSUM),
]
