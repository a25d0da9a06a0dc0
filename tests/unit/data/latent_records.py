"""Small datasets of latents, for tests."""

import json

import ml_dtypes
import numpy as np

from egosim_jax.data.check import check
from egosim_jax.data.manifest import MANIFEST, SEAL, sealed
from egosim_jax.data.records import to_bytes
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.types import VideoSpec

SPEC = VideoSpec(frames=9, height=32, width=48)


def latents(index, shape=(3, 4, 6, 16)):
    rng = np.random.default_rng(index)
    return {
        "target": rng.standard_normal(shape).astype(ml_dtypes.bfloat16),
        "mask": rng.integers(0, 2, (3, 4, 6, 4)).astype(np.uint8),
        "text": rng.standard_normal((5, 8)).astype(np.float32),
    }


def write_latents(folder, records=7):
    """Write records of latents in several shards; return the folder."""
    with ShardWriter(
        folder,
        kind="latents",
        spec=SPEC,
        provenance={"vae": "abc"},
        shard_bytes=13_000,
    ) as writer:
        for index in range(records):
            writer.add(latents(index), {"video_id": f"clip{index}", "prompt": f"é {index}"})
    return folder


def rewrite_manifest(folder, change):
    """Change a manifest and write it with a valid hash, as an attacker would."""
    fields = json.loads((folder / MANIFEST).read_text())
    del fields[SEAL]
    change(fields)
    (folder / MANIFEST).write_text(json.dumps({**fields, SEAL: sealed(fields)}))


def first_shard(folder):
    return folder / "shard-00000.array_record"


def problems(folder):
    return [problem for _, found in check(folder) for problem in found]


def damage_record(folder, index):
    """Flip a byte in a record's arrays in the first shard; return the shard."""
    path = first_shard(folder)
    data = bytearray(path.read_bytes())
    data[data.index(to_bytes(ShardReader(folder)[index])[200:300])] ^= 0xFF
    path.write_bytes(data)
    return path
