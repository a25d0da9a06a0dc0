"""A recording of images ends where images are missing, whatever their numbering."""

import json
import shutil
from datetime import datetime, timedelta

import numpy as np
import pytest

from egosim_jax.data.readers.colmap import Colmap
from egosim_jax.data.readers.images import longest_run
from egosim_jax.data.readers.nerfstudio import Nerfstudio
from egosim_jax.data.readers.record3d import Record3D
from tests.unit.data.readers import test_colmap, test_nerfstudio, test_record3d


def edit_transforms(root, change):
    path = root / "transforms.json"
    written = json.loads(path.read_text())
    written["frames"] = [
        entry
        for entry in written["frames"]
        if change(entry, int(entry["file_path"].split("_")[-1].split(".")[0]))
    ]
    path.write_text(json.dumps(written))


def drop(*numbers):
    return lambda entry, number: number not in numbers


def pose(number, value):
    def change(entry, n):
        if n == number:
            entry["transform_matrix"] = value
        return True

    return change


def every_tenth(root):
    """Number images by tens, without the fifth."""

    def change(entry, number):
        name = f"images/frame_{10 * number:05d}.png"
        (root / entry["file_path"]).rename(root / name)
        entry["file_path"] = name
        return number != 4

    return change


NERFSTUDIO = {
    "absent": (lambda root: edit_transforms(root, drop(4, 5)), slice(6, 12)),
    "deleted": (lambda root: (root / "images/frame_7.png").unlink(), slice(0, 7)),
    "every_tenth": (lambda root: edit_transforms(root, every_tenth(root)), slice(5, 12)),
    "zeros": (lambda root: edit_transforms(root, pose(5, np.zeros((4, 4)).tolist())), slice(6, 12)),
    "nan": (lambda root: edit_transforms(root, pose(6, [[float("nan")] * 4] * 4)), slice(0, 6)),
    "null": (lambda root: edit_transforms(root, pose(2, None)), slice(3, 12)),
    "two_gaps": (lambda root: edit_transforms(root, drop(2, 9)), slice(3, 9)),
}


@pytest.mark.parametrize("member", NERFSTUDIO)
def test_the_run_of_a_nerfstudio_capture(world, tmp_path, imported, member):
    damage, run = NERFSTUDIO[member]
    test_nerfstudio.write_capture(tmp_path / "desk", world)
    damage(tmp_path / "desk")
    recording = imported(Nerfstudio(source=tmp_path / "desk", fps=10.0))[0]["desk"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses[run], atol=1e-12)
    corner = recording.read_frames().frames[:, 2:6, 2:6].mean(axis=(1, 2, 3))
    np.testing.assert_allclose(corner, 10 + 20 * np.arange(12)[run], atol=8)
    assert "the longest run without gaps" in recording.provenance["used"]


@pytest.mark.parametrize(
    ("gone", "run", "deleted"),
    [((3,), slice(4, 12), False), ((4,), slice(5, 12), True), ((7, 8), slice(0, 7), True)],
)
def test_the_run_of_a_colmap_model(world, tmp_path, imported, gone, run, deleted):
    test_colmap.write_model(tmp_path / "room", world, binary=deleted, skip=gone)
    for number in gone if deleted else ():
        (tmp_path / f"room/images/frame_{number}.png").unlink()
    recording = imported(Colmap(source=tmp_path / "room", fps=10.0))[0]["room"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses[run], atol=1e-9)
    assert recording.points.frames.max() == recording.frames - 1


@pytest.mark.parametrize(("gone", "run"), [([3], slice(4, 12)), ([0, 8], slice(1, 8))])
def test_the_run_of_a_record3d_capture(world, tmp_path, imported, gone, run):
    test_record3d.write_capture(tmp_path / "scan.r3d", world)
    shutil.unpack_archive(tmp_path / "scan.r3d", tmp_path / "room", "zip")
    for number in gone:
        (tmp_path / f"room/rgbd/{number}.jpg").unlink()
    recording = imported(Record3D(source=tmp_path / "room"))[0]["room"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses[run], atol=1e-9)
    corner = recording.read_frames().frames[:, 2:6, 2:6].mean(axis=(1, 2, 3))
    np.testing.assert_allclose(corner, 10 + 20 * np.arange(12)[run], atol=8)


@pytest.mark.parametrize(
    ("names", "run"),
    [
        (["1.png", "2.png", "3.png", "7.png", "8.png"], slice(0, 3)),
        (["a_0010", "a_0020", "a_0030", "a_0050", "a_0060", "a_0070", "a_0080"], slice(3, 7)),
        (["169.10.png", "169.13.png", "169.17.png", "169.30.png", "169.33.png"], slice(0, 3)),
        (["33366.jpg", "66733.jpg", "100100.jpg", "200200.jpg", "233567.jpg"], slice(0, 3)),
        (["left/8", "left/9", "right/10", "right/11", "right/12"], slice(2, 5)),
        (["x1_v2.png", "x2_v2.png", "x2_v2.png", "x3_v2.png", "x4_v2.png"], slice(2, 5)),
        (["a.png", "b.png", "z.png"], slice(0, 3)),
        (["take2_1.png", "take2_2.png", "take2_4.png"], slice(0, 2)),
    ],
)
def test_numbers_in_names_show_gaps(names, run):
    assert longest_run(names, lambda name: True) == [*range(len(names))][run]


def clock(form, times):
    return [f"{datetime(2025, 1, 1, 12, 0, 50) + timedelta(seconds=t):{form}}" for t in times]


SEQUENCES = {
    "two cameras": ([f"cam{c}_{n:05d}" for c in (0, 1) for n in range(6)], range(6)),
    "the longer camera": ([f"cam{c}_{n:05d}" for c in (0, 1) for n in range(4 + c)], range(4, 9)),
    "alternating": ([f"{n:05d}_cam{c}" for n in range(6) for c in (0, 1)], range(0, 12, 2)),
    "left and right": ([f"{c}_{n:05d}" for c in ("l", "r") for n in range(6)], range(6)),
    "one number": (["take1_1", "take1_2", "take1_3", "take2_3", "take2_4"], range(3)),
    "number and time": ([f"{n:05d}_{9 + n / 30:.3f}" for n in range(40)], range(40)),
    "time with a hole": ([f"{n:05d}_{9 + (n + 9 * (n > 3)) / 30:.3f}" for n in range(9)],
                         range(4, 9)),
    "seconds": (clock("%Y%m%d_%H%M%S", range(20)), range(20)),
    "a hole of seconds": (clock("%Y%m%d_%H%M%S", [0, 1, 2, 10, 11, 12, 13]), range(3, 7)),
    "a second less": (clock("IMG_%Y-%m-%d-%H-%M-%S", [8, 9, 11, 12, 13]), range(2, 5)),
    "decimals": (clock("%Y-%m-%dT%H-%M-%S.%f", [n / 10 for n in range(150)]), range(150)),
    "a hole of decimals": (clock("%Y%m%d%H%M%S%f", [n / 10 for n in (*range(95), 99)]),
                           range(95)),
    "counted in seconds": (
        [f"{time}_{n:05d}" for n, time in enumerate(
            clock("%Y%m%d_%H%M%S", [n / 5 for n in range(80)]))], range(80)),
    "recorded twice": (
        [f"2025-01-01_12-{m:02d}-00_{n:04d}" for m in (0, 30) for n in range(5)], range(5)),
    "since 1970": ([f"17000000{n // 10:02d}_{n % 10}00000000" for n in range(30)], range(30)),
    "no date": ([f"20251399_{n:06d}" for n in range(5)], range(5)),
}  # fmt: skip


@pytest.mark.parametrize("member", SEQUENCES)
def test_the_longest_run_is_of_one_sequence(member):
    names, run = SEQUENCES[member]
    assert longest_run([f"{name}.png" for name in names], lambda name: True) == [*run]
