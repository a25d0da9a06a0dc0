"""Fuzzing targets: files that expand."""

from __future__ import annotations

import io
import json
import random
import tarfile
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from egosim_jax.data.readers.hot3d import Hot3D
from egosim_jax.data.readers.record3d import Record3D
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import Action, Cameras, GroundTruth
from tests.fuzz.mutations import INTERESTING, json_value
from tests.fuzz.target import Target, pixels
from tests.fuzz.targets_convert import zip_number
from tests.fuzz.targets_run import a_state
from tests.unit.data.readers.test_hot3d import write_clip

FRAMES, SIZE = 5, (32, 48)
LOSSY = "files of others have no checksum, and the fields of a description may have other values"


# Archives


def make_episode(folder: Path) -> None:
    """Write an episode of a clip with ground truth as its byte format."""
    cameras = Cameras(
        world_from_camera=np.tile(np.eye(4), (FRAMES, 1, 1)),
        intrinsics_px=np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]),
        height=SIZE[0],
        width=SIZE[1],
    )
    joints = np.full((FRAMES, 2, 21, 3), np.nan)
    action = Action(kind="human", cameras=cameras, joints_m=joints, prompt="Fold it.")
    truth = GroundTruth(frames=pixels(FRAMES, *SIZE, 3))
    Episode(state=a_state(), actions=(action,), fps=16, ground_truth=(truth,)).save(
        folder / "x.zip"
    )


def read_episode(folder: Path) -> Any:
    """Read it."""
    episode = Episode.load(folder / "x.zip")
    return episode.state.points_m, [action.joints_m for action in episode.actions]


def make_capture(folder: Path) -> None:
    """Write a Record3D capture of two frames."""
    about = {"w": 48, "h": 32, "dw": 4, "dh": 3, "fps": 30, "poses": [[0, 0, 0, 1, 0, 0, 0]] * 2,
             "K": [40, 0, 0, 0, 40, 0, 24, 16, 1]}  # fmt: skip
    jpeg = io.BytesIO()
    Image.fromarray(pixels(*SIZE, 3)).save(jpeg, "JPEG")
    with zipfile.ZipFile(folder / "scan.r3d", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", json.dumps(about))
        for number in range(2):
            archive.writestr(f"rgbd/{number}.jpg", jpeg.getvalue())
            archive.writestr(f"rgbd/{number}.depth", bytes(48))


def read_capture(folder: Path) -> Any:
    """Read it, which writes its video."""
    (entry,) = Record3D(source=folder / "scan.r3d").find()
    return entry.read(folder / "out").world_from_camera


def other_entries(data: bytes, rng: random.Random) -> bytes:
    """Write the archive again with other contents, methods and names."""
    file = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = [(info.filename, archive.read(info)) for info in archive.infolist()]
    except (zipfile.BadZipFile, zlib.error, OSError, ValueError, NotImplementedError):
        return data[:-1]
    if not entries:
        return data[:-1]
    at = rng.randrange(len(entries))
    name, content = entries[at]
    match rng.randrange(5):
        case 0:
            entries[at] = name, bytes(rng.choice((0, 1, 10**6, 10**8)))
        case 1:
            values = (b"[" * 10**6, b"[],", b'{"a":0},', b"0,", b"9" * 10**6)
            value = rng.choice(values)
            entries[at] = name, b"[" + value * (rng.choice((1, 10**7)) // len(value) + 1) + b"0]"
        case 2:
            entries[at] = rng.choice((f"../{name}", f"/{name}", name + "x", "a/", "\xe9")), content
        case 3:
            entries += [(f"{name}{number}", content) for number in range(rng.choice((1, 3000)))]
        case _:
            entries[at] = name, json_value(content, rng)
    methods = (zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA)
    with zipfile.ZipFile(file, "w", rng.choice(methods)) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return file.getvalue()


def overlap(data: bytes, rng: random.Random) -> bytes:
    """Let an entry of the directory refer to the bytes of another one."""
    places = [at for at in range(len(data) - 46) if data[at : at + 4] == b"PK\1\2"]
    if len(places) < 2:
        return data[:-1]
    one, other = rng.sample(places, 2)
    changed = bytearray(data)
    for field, size in rng.choice((((42, 4),), ((16, 12), (42, 4)))):
        changed[one + field : one + field + size] = data[other + field : other + field + size]
    return bytes(changed)


# Tar files of HOT3D


def make_tar(folder: Path) -> None:
    """Write a clip of HOT3D."""
    write_clip(folder / "clip.tar")


def read_tar(folder: Path) -> Any:
    """Read it, which writes its video."""
    (entry,) = Hot3D(source=folder / "clip.tar").find()
    return entry.read(folder / "out").world_from_camera


def other_header(data: bytes, rng: random.Random) -> bytes:
    """Change a field of a member's header, with its checksum."""
    at = 512 * rng.randrange(max(1, len(data) // 512))
    header = bytearray(data[at : at + 512])
    if header[257:262] != b"ustar":
        return data[:-1]
    match rng.randrange(4):
        case 0:
            header[156:157] = rng.choice((b"S", b"x", b"g", b"L", b"K", b"1", b"2", b"5", b"7"))
        case 1:
            header[124:136] = b"%011o\0" % (rng.choice(INTERESTING) % 8**11)
        case 2:
            header[124:136] = b"\x80" + rng.choice(INTERESTING).to_bytes(11, "big", signed=True)
        case _:
            place = rng.randrange(500)
            header[place : place + 8] = rng.randbytes(8)
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    return data[:at] + bytes(header) + data[at + 512 :]


def pax_headers(data: bytes, rng: random.Random) -> bytes:
    """Put a member with extended headers first, as of a sparse file."""
    keys = ("GNU.sparse.major", "GNU.sparse.minor", "GNU.sparse.name", "GNU.sparse.map", "size",
            "GNU.sparse.size", "GNU.sparse.numblocks", "GNU.sparse.realsize", "path")  # fmt: skip
    values = ("0", "1", "-1", "x", "0,1", "0,512,9", "9" * 50, "1099511627776", "", "a/b")
    info = tarfile.TarInfo("000000.cameras.json")
    info.size = rng.choice((0, 5, 600))
    info.pax_headers = {key: rng.choice(values) for key in rng.sample(keys, rng.randint(1, 5))}
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=tarfile.PAX_FORMAT) as tar:
        tar.addfile(info, io.BytesIO(b"1\n0\n512\n".ljust(600, b"0")))
        place = tar.offset
    return file.getvalue()[:place] + data


ARCHIVE = (zip_number, other_entries, overlap)
TARGETS: list[Target] = [
    Target(
        name="episode zip",
        make=make_episode,
        read=read_episode,
        files=("x.zip",),
        lossy=LOSSY,
        mutations=ARCHIVE,
    ),
    Target(
        name="r3d",
        make=make_capture,
        read=read_capture,
        files=("scan.r3d",),
        lossy=LOSSY,
        mutations=ARCHIVE,
    ),
    Target(
        name="tar of HOT3D",
        make=make_tar,
        read=read_tar,
        files=("clip.tar",),
        lossy=LOSSY,
        mutations=(other_header, pax_headers),
    ),
]
