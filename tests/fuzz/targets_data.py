"""Fuzzing targets: tables of clips, and shards."""

from __future__ import annotations

import csv
import io
import json
import random
import re
import struct
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np

from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.types import VideoSpec
from tests.fuzz.mutations import NUMBERS, json_value
from tests.fuzz.target import Target, pixels

# Metadata

ROWS = [
    {
        "video": f"{name}/video.mp4",
        "ego_prior_video": f"{name}/prior.mp4",
        "hand_keypoint_video": f"{name}/hands.mp4",
        "first_frame": f"{name}/first.png",
        "prompt": prompt,
        "video_id": name,
        "split": "train",
    }
    for name, prompt in (("a/1", "take it,\nslowly"), ("b", "é \u2028 put it down"), ("c", '"no"'))
]
KEYS = tuple(ROWS[0])
CELLS: tuple[Any, ...] = ("", "nan", "../x", "a/../b", "a//b", "/etc/x", "\0", "é", "x" * 300, None,
                          3, 1e400, True, [], {}, ["a"], "\u2028", '"', "a,b", "\n")  # fmt: skip


def make_metadata(folder: Path) -> None:
    """Write the same rows as CSV and as JSON lines."""
    text = io.StringIO()
    writer = csv.DictWriter(text, KEYS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(ROWS)
    (folder / "m.csv").write_text(text.getvalue(), encoding="utf-8")
    lines = (json.dumps(row, ensure_ascii=False) + "\n" for row in ROWS)
    (folder / "m.jsonl").write_text("".join(lines), encoding="utf-8")


def read_tables(folder: Path) -> Any:
    """Read both tables."""
    return {
        name: [
            [clip.video_id, clip.prompt, str(clip.prior), str(clip.hands), str(clip.first_frame),
             str(clip.mask), str(clip.target), dict(clip.extra)]
            for clip in read_metadata(folder / name)
        ]
        for name in ("m.csv", "m.jsonl")
    }  # fmt: skip


def change_cell(data: bytes, rng: random.Random) -> bytes:
    """Put another value or name into a row of either table."""
    if data.startswith(b"{"):
        return json_value(data, rng)
    try:
        rows = list(csv.reader(io.StringIO(data.decode(), newline="")))
    except (UnicodeDecodeError, csv.Error):
        return data
    row = rng.choice(rows)
    if not row:
        return data
    match rng.randrange(4):
        case 0:
            del row[rng.randrange(len(row))]
        case 1:
            row.insert(rng.randrange(len(row) + 1), str(rng.choice(CELLS)))
        case 2:
            rows.remove(row)
        case _:
            row[rng.randrange(len(row))] = str(rng.choice((*CELLS, *KEYS)))
    text = io.StringIO()
    csv.writer(text, lineterminator=rng.choice(("\n", "\r\n", "\r"))).writerows(rows)
    return text.getvalue().encode("utf-8", "replace")


# Shards

SPEC = VideoSpec(frames=5, height=16, width=16)


def make_shards(folder: Path) -> None:
    """Write three records of tiny frames in two shards."""
    with ShardWriter(
        folder / "data", kind="frames", spec=SPEC, provenance={"from": "noise"}, shard_bytes=18_000
    ) as writer:
        for number in range(3):
            videos = {name: pixels(5, 16, 16, 3) for name in ("prior", "hands")}
            still = {"mask": pixels(5, 16, 16), "first_frame": pixels(16, 16, 3)}
            names = {"video_id": f"clip_{number}", "prompt": "é", "extra": {"split": "train"}}
            writer.add({**videos, **still}, names)


def make_latents(folder: Path) -> None:
    """Write three records of tiny latents, as the encoders leave them."""
    provenance = {"config": "debug", "source": "0" * 64, "encoders": {"vae": "1" * 64}}
    with ShardWriter(
        folder / "data", kind="latents", spec=SPEC, provenance=provenance, shard_bytes=3_000
    ) as writer:
        for number in range(3):
            rng = np.random.default_rng(number)
            arrays = {
                name: rng.normal(size=(2, 2, 2, 16)).astype(ml_dtypes.bfloat16)
                for name in ("target", "prior", "hands")
            }
            arrays |= {"mask": pixels(2, 2, 2, 4), "text": np.ones((3, 8), np.float32)}
            names = {"video_id": f"clip_{number}", "prompt": "take it", "extra": {}, "start": 0}
            writer.add(arrays, names)


def read_shards(folder: Path) -> Any:
    """Open a dataset and read every record, as the loader does."""
    reader = ShardReader(folder / "data")
    records = [(dict(record.metadata), dict(record.arrays)) for record in reader]
    return asdict(reader.manifest), records


def change_dataset(data: bytes, rng: random.Random) -> bytes:
    """Change a value of the manifest; of a shard, a bit or eight bytes where it is not padding."""
    if data.startswith(b"{"):
        return json_value(data, rng)
    places = [match.start() for match in re.finditer(rb"[^\0]", data)]
    if not places:
        return data
    at = rng.choice(places)
    if rng.random() < 0.5:
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    number = rng.choice((*NUMBERS, 2**63, 2**64 - 1))
    return data[:at] + struct.pack("<Q", number) + data[at + 8 :]


def _dataset(name: str, make: Callable[[Path], None]) -> Target:
    return Target(
        name=name,
        make=make,
        read=read_shards,
        files=("data/manifest.json", "data/*.array_record"),
        sealed=True,
        mutations=(change_dataset,),
    )


TARGETS: list[Target] = [
    Target(
        name="metadata",
        make=make_metadata,
        read=read_tables,
        files=("m.csv", "m.jsonl"),
        lossy="tables have no checksum: another text is as good as the one before",
        mutations=(change_cell,),
    ),
    _dataset("shards", make_shards),
    _dataset("latents", make_latents),
]
