"""Fuzzing targets: videos, images and point clouds."""

from __future__ import annotations

import random
import re
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from egosim_jax.io.images import read_image
from egosim_jax.io.video import read_video
from egosim_jax.io.writing import encode_video
from egosim_jax.state.ply import read_points
from tests.fuzz.mutations import NUMBERS
from tests.fuzz.target import Target, pixels

WORDS = (
    b"",
    b"0",
    b"-1",
    b"500000000",
    b"1" * 40,
    b"nan",
    b"list",
    b"double",
    b"uchar",
    b"x" * 999,
)


# PLY

PROPERTIES = [("float", c) for c in "xyz"] + [("uchar", c) for c in ("red", "green", "blue")]
DTYPES = {"float": "f4", "uchar": "u1"}


def make_ply(folder: Path) -> None:
    """Write the same three points as text and in both byte orders, with a face behind them."""
    rows = [(0.5, 1, 2, 10, 20, 30), (3, 4, 5, 40, 50, 60), (6, 7, -8, 70, 80, 90)]
    for name, order in (("ascii", "="), ("binary_little_endian", "<"), ("binary_big_endian", ">")):
        lines = ["ply", f"format {name} 1.0", "comment three points", "element vertex 3"]
        lines += [f"property {kind} {c}" for kind, c in PROPERTIES]
        lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
        if name == "ascii":
            body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode() + b"3 0 1 2\n"
        else:
            body = np.array(rows, [(c, order + DTYPES[k]) for k, c in PROPERTIES]).tobytes()
            body += struct.pack(f"{order}B3i", 3, 0, 1, 2)
        (folder / f"{name}.ply").write_bytes("\n".join(lines).encode() + body)


def read_ply(folder: Path) -> Any:
    """Read the points of each file, as names and rows."""
    return {path.name: _rows(read_points(path)) for path in sorted(folder.glob("*.ply"))}


def _rows(points: np.ndarray) -> Any:
    return points.dtype.names, [[float(value) for value in row] for row in points.tolist()]


def change_ply_word(data: bytes, rng: random.Random) -> bytes:
    """Put another count, type or name into the header."""
    end = data.find(b"end_header")
    words = list(re.finditer(rb"[^\s]+", data[: max(end, 0)]))
    if not words:
        return data
    word = rng.choice(words)
    return data[: word.start()] + rng.choice(WORDS) + data[word.end() :]


def change_ply_lines(data: bytes, rng: random.Random) -> bytes:
    """Drop, repeat or exchange lines of the header, or add an element."""
    head, end, body = data.partition(b"end_header")
    lines = head.split(b"\n")
    at = rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[at])
        case 2:
            other = rng.randrange(len(lines))
            lines[at], lines[other] = lines[other], lines[at]
        case _:
            count = rng.choice((0, 1, 3, 10**9))
            lines[at:at] = [b"element edge %d" % count, b"property int vertex1"]
    return b"\n".join(lines) + end + body


# MP4 and PNG


def make_mp4(folder: Path) -> None:
    """Write three small frames of noise as H.264."""
    (folder / "a.mp4").write_bytes(encode_video(pixels(3, 16, 16, 3), 16, crf=40))


def read_mp4(folder: Path) -> Any:
    """Decode all frames."""
    video = read_video(folder / "a.mp4")
    return video.fps, video.frames


BOXES = re.compile(
    rb"ftyp|moov|mvhd|trak|tkhd|edts|elst|mdia|mdhd|hdlr|minf|vmhd|dinf|stbl|stsd|avc1|avcC|colr|"
    rb"stts|stss|ctts|stsc|stsz|stco|udta|mdat"
)


def change_box(data: bytes, rng: random.Random) -> bytes:
    """Put another number into a box: its size, or one of its first fields."""
    boxes = list(BOXES.finditer(data))
    if not boxes:
        return data
    at = rng.choice(boxes).start() + rng.choice((-4, -4, 4, 8, 12, 16, 20, 24))
    if not 0 <= at <= len(data) - 4:
        return data
    (old,) = struct.unpack_from(">I", data, at)
    new = rng.choice((*NUMBERS, old + 1, old - 1, old * 2, old // 2)) % 2**32
    return data[:at] + struct.pack(">I", new) + data[at + 4 :]


def move_box(data: bytes, rng: random.Random) -> bytes:
    """Drop, repeat or rename a box."""
    boxes = list(BOXES.finditer(data))
    if not boxes:
        return data
    start = rng.choice(boxes).start() - 4
    end = start + int.from_bytes(data[max(start, 0) : start + 4], "big")
    box = data[start:end]
    match rng.randrange(3):
        case 0:
            return data[:start] + data[end:]
        case 1:
            return data[:end] + box + data[end:]
        case _:
            other = rng.choice(boxes).group()
            return data[: start + 4] + other + data[start + 8 :]


def make_png(folder: Path) -> None:
    """Write 8-bit RGB, a palette and 16-bit gray, with some text."""
    Image.fromarray(pixels(6, 5, 3)).save(folder / "rgb.png")
    Image.fromarray(pixels(6, 5, 3)).quantize(8).save(folder / "palette.png")
    Image.fromarray(np.arange(30, dtype=np.uint16).reshape(6, 5) * 2000).save(folder / "gray.png")


def read_png(folder: Path) -> Any:
    """Decode all three."""
    return {path.name: read_image(path) for path in sorted(folder.glob("*.png"))}


def change_chunk(data: bytes, rng: random.Random) -> bytes:
    """Change, drop, repeat or add a chunk, with its CRC as it should be."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    if not chunks:
        return data
    number = rng.randrange(len(chunks))
    kind, content = chunks[number]
    match rng.randrange(5):
        case 0:
            del chunks[number]
        case 1:
            chunks.insert(number, chunks[number])
        case 2:
            bomb = zlib.compress(bytes(rng.choice((10, 10**6, 10**7))))
            new = rng.choice(((b"zTXt", b"a\0\0" + bomb), (b"iCCP", b"a\0\0" + bomb),
                              (b"tRNS", b"\0"), (b"PLTE", b"\0" * 3), (b"acTL", bytes(8)),
                              (b"eXIf", b"II*\0" + bytes(9)), (b"IDAT", bomb)))  # fmt: skip
            chunks.insert(rng.randrange(1, len(chunks) + 1), new)
        case 3 if content:
            place = rng.randrange(len(content))
            changed = content[:place] + rng.randbytes(1) + content[place + 1 :]
            chunks[number] = kind, changed
        case _ if len(content) >= 8:
            place = rng.choice((0, 4))
            value = struct.pack(">I", rng.choice(NUMBERS))
            chunks[number] = kind, content[:place] + value + content[place + 4 :]
        case _:
            chunks[number] = bytes(rng.choices(range(65, 123), k=4)), content
    return data[:8] + b"".join(
        struct.pack(">I", len(c)) + k + c + struct.pack(">I", zlib.crc32(k + c)) for k, c in chunks
    )


TARGETS: list[Target] = [
    Target(
        name="ply",
        make=make_ply,
        read=read_ply,
        files=("*.ply",),
        lossy="PLY has no checksum: another number or type is as good as the one before.",
        mutations=(change_ply_word, change_ply_lines),
    ),
    Target(
        name="mp4",
        make=make_mp4,
        read=read_mp4,
        files=("*.mp4",),
        lossy="H.264 and MP4 have no checksum: a bit that leaves a stream or a table valid gives "
        "other pixels, another rate, matrix or edit list, and no decoder notices.",
        mutations=(change_box, move_box),
    ),
    Target(
        name="png",
        make=make_png,
        read=read_png,
        files=("*.png",),
        lossy="A chunk whose CRC was computed again is as good as any other.",
        mutations=(change_chunk,),
    ),
]
