"""Record3D: poses from OpenGL's axes, intrinsics, depth, and damaged captures."""

import io
import json
import shutil
import struct
import zipfile

import lzfse
import numpy as np
import pytest
from PIL import Image

from egosim_jax.data.readers import record3d
from egosim_jax.data.readers.record3d import Record3D
from egosim_jax.types import InputError
from tests.captures import quaternions

FLIP = np.diag([1.0, -1, -1, 1])


def jpeg(frame):
    data = io.BytesIO()
    Image.fromarray(frame).save(data, "JPEG", quality=95)
    return data.getvalue()


def write_capture(path, world, *, per_frame=True, images="rgbd", **changes):
    opengl = world.poses @ FLIP
    (fx, _, cx), (_, fy, cy), _ = world.intrinsics.tolist()
    metadata = {
        "w": world.width,
        "h": world.height,
        "dw": 4,
        "dh": 3,
        "fps": 60,
        "K": [fx, 0, 0, 0, fy, 0, cx + 0.5, cy + 0.5, 1],
        "poses": np.concatenate([quaternions(opengl[:, :3, :3]), opengl[:, :3, 3]], 1).tolist(),
    }
    if per_frame:
        metadata["perFrameIntrinsicCoeffs"] = [[fx, fy, cx + 0.5, cy + 0.5]] * world.frames
    metadata |= changes
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(metadata))
        for number, frame in enumerate(world.video):
            archive.writestr(f"{images}/{number}.jpg", jpeg(frame))
            depth = np.full((3, 4), 0.5 + 0.1 * number, np.float32)
            depth[0, 0] = np.nan
            archive.writestr(f"rgbd/{number}.depth", lzfse.compress(depth.tobytes()))


def test_one_matrix_of_intrinsics_serves_all_frames(world, tmp_path, imported):
    write_capture(tmp_path / "scan.r3d", world, per_frame=False)
    recording = imported(Record3D(source=tmp_path))[0]["scan"]
    np.testing.assert_allclose(recording.intrinsics_px, world.intrinsics, atol=1e-9)


TIMES = 10.0 + np.arange(12) / 30


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        (TIMES, range(12)),
        (np.delete([*TIMES, TIMES[-1] + 1 / 30], 5), [0, 1, 2, 3, 4, 5, *range(5, 12)]),
        (np.where(np.arange(12) == 4, TIMES[3], TIMES), [0, 1, 2, 3, 5, *range(5, 12)]),
        (TIMES[:9], range(9)),
        ([*TIMES[:5], None, *TIMES[6:]], [0, 1, 2, 3, 4, 6, *range(6, 12)]),
    ],
    ids=["rate", "missing", "repeated", "shorter", "without"],
)
def test_images_are_taken_by_their_time_stamps(world, tmp_path, imported, stamps, expected):
    stamps = [None if stamp is None else round(float(stamp), 6) for stamp in stamps]
    write_capture(tmp_path / "scan.r3d", world, frameTimestamps=stamps)
    done, problems = imported(Record3D(source=tmp_path))
    assert not problems
    recording = done["scan"]
    assert (recording.fps, recording.frames) == (30, len(expected))
    np.testing.assert_allclose(recording.world_from_camera, world.poses[[*expected]], atol=1e-9)
    shown = recording.read_frames().frames[:, 2:6, 2:6].mean(axis=(1, 2, 3))
    np.testing.assert_allclose(shown, 10 + 20 * np.array(expected), atol=8)


def test_time_stamps_of_too_many_frames_or_with_a_pause_are_refused(
    world, tmp_path, imported, monkeypatch
):
    quick = [*(1e-4 * np.arange(7)), *(0.15 * np.arange(1, 6))]
    write_capture(tmp_path / "pause.r3d", world, frameTimestamps=[*TIMES[:6], *(TIMES[6:] + 1)])
    write_capture(tmp_path / "many.r3d", world, frameTimestamps=quick)
    monkeypatch.setattr(record3d, "MAX_IMAGES", 100)
    done, problems = imported(Record3D(source=tmp_path))
    assert not done
    assert "variable frame rate" in problems["pause"]
    assert "more than 100, the maximum. Split the capture." in problems["many"]


def test_depth_is_in_meters_and_unknown_where_it_is_not_finite(world, tmp_path, imported):
    write_capture(tmp_path / "scan.r3d", world)
    recording = imported(Record3D(source=tmp_path / "scan.r3d"))[0]["scan"]
    depth = recording.read_depth(3)
    assert depth.shape == (world.height, world.width)
    assert depth[-1, -1] == pytest.approx(0.8)
    assert np.isinf(depth[0, 0])


def test_depth_of_low_or_unknown_confidence_is_unknown(world, tmp_path, imported):
    write_capture(tmp_path / "scan.r3d", world)
    with zipfile.ZipFile(tmp_path / "scan.r3d", "a") as archive:
        levels = np.tile(np.array([0, 0, 1, 2], np.uint8), (3, 1))
        for number in range(11):
            archive.writestr(f"rgbd/{number}.conf", lzfse.compress(levels.tobytes()))
    recording = imported(Record3D(source=tmp_path))[0]["scan"]
    depth = recording.read_depth(3)[-1]
    assert np.isinf(depth[: world.width // 2]).all()
    np.testing.assert_allclose(depth[world.width // 2 :], 0.8)
    assert recording.read_depth(11) is None


def test_without_a_matrix_intrinsics_are_unknown(world, tmp_path, imported):
    write_capture(tmp_path / "scan.r3d", world, per_frame=False, K=[])
    recording = imported(Record3D(source=tmp_path))[0]["scan"]
    assert recording.intrinsics_px is None
    np.testing.assert_allclose(recording.world_from_camera, world.poses, atol=1e-9)


@pytest.mark.parametrize("poses", [None, []])
def test_without_poses_images_intrinsics_and_depth_are_read(world, tmp_path, imported, poses):
    write_capture(tmp_path / "scan.r3d", world, poses=poses)
    recording = imported(Record3D(source=tmp_path))[0]["scan"]
    assert recording.world_from_camera is None
    assert not recording.metric
    world.assert_first(recording)
    np.testing.assert_allclose(recording.intrinsics_px, world.intrinsics, atol=1e-9)
    assert recording.read_depth(3)[-1, -1] == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (lzfse.compress(bytes(48))[:9], "cut off"),
        (
            b"bvxn" + struct.pack("<II", 1 << 31, 0) + lzfse.compress(bytes(48)),
            "2,147,483,696 bytes",
        ),
        (b"nothing" * 3, "not an LZFSE stream"),
        (b"bvxn" + struct.pack("<II", 48, 5) + b"wrong" + b"bvx$", "damaged"),
    ],
)
def test_depth_that_is_not_what_it_should_be_is_refused(world, tmp_path, imported, data, message):
    write_capture(tmp_path / "scan.r3d", world)
    shutil.unpack_archive(tmp_path / "scan.r3d", tmp_path / "room", "zip")
    (tmp_path / "room/rgbd/4.depth").write_bytes(data)
    problem = imported(Record3D(source=tmp_path / "room"))[1]["room"]
    assert message in problem


def test_without_the_library_depth_is_unknown_and_that_is_recorded(
    world, tmp_path, imported, monkeypatch
):
    write_capture(tmp_path / "scan.r3d", world)
    monkeypatch.setattr(record3d, "find_spec", lambda name: None)
    recording = imported(Record3D(source=tmp_path))[0]["scan"]
    assert recording.depth is None
    assert "pip install" in recording.provenance["depth"]


@pytest.mark.parametrize("data", [bytes(300_000), bytes(range(64)) * 999, b"short"])
def test_the_size_of_a_stream_is_known_before_it_is_unpacked(data):
    packed = lzfse.compress(data)
    assert record3d.unpacked_size(packed) == len(data)
    assert record3d.unpack_lzfse(packed, len(data)) == data


def test_a_folder_that_was_exported_is_read(world, tmp_path, imported):
    write_capture(tmp_path / "scan.r3d", world, images="rgb")
    shutil.unpack_archive(tmp_path / "scan.r3d", tmp_path / "room", "zip")
    (tmp_path / "room/metadata").rename(tmp_path / "room/metadata.json")
    recording = imported(Record3D(source=tmp_path / "room"))[0]["room"]
    world.assert_first(recording)


def test_damaged_captures_are_named(world, tmp_path, imported):
    source = tmp_path / "set"
    source.mkdir()
    write_capture(source / "good.r3d", world)
    write_capture(source / "few.r3d", world, poses=[[0, 0, 0, 1, 0, 0, 0]] * 5)
    write_capture(source / "wild.r3d", world, poses=[[0, 0, 0, 1, float("nan"), 0, 0]] * 12)
    write_capture(source / "long.r3d", world, poses=[[0, 0, 0, 2, 0, 0, 0]] * 12)
    zoom = [[90 + n, 90, 64, 48] for n in range(12)]
    write_capture(source / "zoom.r3d", world, perFrameIntrinsicCoeffs=zoom)
    write_capture(source / "small.r3d", world, w=64)
    (source / "cut.r3d").write_bytes((source / "good.r3d").read_bytes()[:3000])
    done, problems = imported(Record3D(source=source))
    assert list(done) == ["good"]
    for name, message in {
        "few": "5 poses",
        "wild": "finite numbers",
        "long": "not a rigid transform",
        "zoom": "Lock the focus",
        "small": "calibrated for 64x96",
        "cut": "not a readable .r3d",
    }.items():
        assert message in problems[name]


def test_a_folder_without_captures_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no \.r3d files"):
        list(Record3D(source=tmp_path).find())
