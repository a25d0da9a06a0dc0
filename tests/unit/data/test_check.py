"""The check of a dataset names damaged files and records."""

import numpy as np
import pytest

from egosim_jax.data.shards import ShardWriter
from egosim_jax.io.writing import encode_video
from egosim_jax.types import VideoSpec
from tests.unit.data.latent_records import (
    damage_record,
    first_shard,
    latents,
    problems,
    rewrite_manifest,
)


def test_valid_shards_have_no_problems(folder):
    assert problems(folder) == []


def test_check_names_a_flipped_byte(folder):
    path = damage_record(folder, 1)
    found = problems(folder)
    assert found[0] == f"{path}: its SHA-256 differs from the manifest"
    assert found[1].startswith(f"{path}, record 1: cannot be read")
    assert len(found) == 2


def test_check_names_a_file_that_is_no_array_record(folder):
    path = first_shard(folder)
    path.write_bytes(b"x" * path.stat().st_size)
    assert f"{path}: 0 records, expected 4" in problems(folder)


def test_check_names_a_wrong_record_count(folder):
    rewrite_manifest(folder, lambda fields: fields["shards"][0].update(records=3))
    assert problems(folder) == [f"{first_shard(folder)}: 4 records, expected 3"]


def test_check_names_arrays_that_are_not_as_the_manifest_says(folder):
    def change(fields):
        fields["arrays"]["text"]["shape"] = [5, 9]
        fields["arrays"]["mask"]["dtype"] = "int32"
        fields["arrays"]["hands"] = fields["arrays"].pop("target")

    rewrite_manifest(folder, change)
    found = "\n".join(problems(folder))
    assert "text is float32 (5, 8), expected float32 (5, 9)" in found
    assert "mask is uint8 (3, 4, 6, 4), expected int32" in found
    assert "target is missing in the manifest" in found
    assert "hands is missing in the record" in found


def test_check_names_numbers_that_are_not_finite(tmp_path):
    arrays = latents(0)
    arrays["target"][0, 0, 0, 0] = np.nan
    with ShardWriter(tmp_path, kind="latents") as writer:
        writer.add(arrays, {"video_id": "a"})
    assert problems(tmp_path) == [
        f"{first_shard(tmp_path)}, record 0: target has values that are not finite"
    ]


def test_check_names_an_id_that_is_a_path(tmp_path):
    with ShardWriter(tmp_path, kind="latents") as writer:
        writer.add(latents(0), {"video_id": "../../etc/x"})
    assert "'../../etc/x' is not a valid file name" in problems(tmp_path)[0]


def as_bytes(frames):
    return np.frombuffer(encode_video(np.zeros((frames, 32, 48, 3), np.uint8), 16), np.uint8)


NOTHING = np.zeros(99, np.uint8)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"prior": as_bytes(10)}, "prior of 10 frames cannot be encoded"),
        ({"prior": as_bytes(9), "hands": as_bytes(5)}, "the frames and sizes disagree"),
        ({"prior": as_bytes(9), "hands": NOTHING}, "hands is not a readable video"),
        ({"first_frame": NOTHING}, "first_frame is not a readable image"),
    ],
)
def test_check_decodes_every_video_and_image(tmp_path, arrays, message):
    with ShardWriter(tmp_path, kind="videos") as writer:
        writer.add(arrays, {"video_id": "a"})
    assert any(message in problem for problem in problems(tmp_path))


@pytest.mark.parametrize("other", ["target", "prior", "hands", "mask", "first_frame"])
def test_check_compares_the_sizes_of_all_frames(tmp_path, other):
    spec = VideoSpec(frames=5, height=32, width=48, fps=8)
    shape = {name: (5, 32, 48, 3) for name in ("target", "prior", "hands")}
    shape |= {"mask": (5, 32, 48), "first_frame": (32, 48, 3)}
    shape[other] = (*shape[other][:-2], 64, 3) if other != "mask" else (5, 32, 64)
    with ShardWriter(tmp_path, kind="frames", spec=spec) as writer:
        writer.add({n: np.zeros(s, np.uint8) for n, s in shape.items()}, {"video_id": "a"})
    assert "the frames and sizes disagree" in problems(tmp_path)[0]
