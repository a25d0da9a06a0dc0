"""EgoDex: cameras, joint order and captions of a tiny episode, and hostile HDF5 files."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import pytest

from egosim_jax.data.readers.egodex import JOINT_NAMES, SIDES, EgoDex
from tests.captures import World

METACARPALS = [f"{f}FingerMetacarpal" for f in ("Index", "Middle", "Ring", "Little")]
BODY = ["hip", *(f"spine{n}" for n in range(1, 8)), *(f"neck{n}" for n in range(1, 5))]


def write_episode(world, path, *, confidence=1.0, attributes=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    world.write_video(path.with_suffix(".mp4"))
    intrinsics = world.intrinsics + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    with h5py.File(path, "w") as file:
        file["camera/intrinsic"] = intrinsics.astype(np.float32)
        poses = {"camera": world.poses}
        for number, side in enumerate(SIDES):
            for joint, name in enumerate(JOINT_NAMES):
                pose = np.tile(np.eye(4), (world.frames, 1, 1))
                pose[:, :3, 3] = world.joints[:, number, joint]
                poses[side + name] = pose
            for name in (*METACARPALS, "Shoulder", "Arm", "Forearm"):
                poses[side + name] = np.tile(np.eye(4), (world.frames, 1, 1))
        poses |= {name: np.tile(np.eye(4), (world.frames, 1, 1)) for name in BODY}
        assert len(poses) == 69
        for name, pose in poses.items():
            kwargs = {"compression": "gzip"} if name == "camera" else {}
            file.create_dataset(f"transforms/{name}", data=pose.astype(np.float32), **kwargs)
            if name != "camera":
                file[f"confidences/{name}"] = np.full(
                    world.frames, confidence if name.startswith("left") else 1.0, np.float32
                )
        file.attrs.update(
            attributes
            or {
                "llm_description": "Fold the towel.",
                "llm_description2": "Unfold the towel.",
                "which_llm_description": "2",
                "llm_type": "reversible",
                "llm_objects": ["towel", "table"],
            }
        )
    return path


@cache
def sample():
    """The bytes of a default episode's files, by suffix: most tests change a copy."""
    with TemporaryDirectory() as folder:
        path = write_episode(World(), Path(folder) / "0.hdf5")
        return {suffix: path.with_suffix(suffix).read_bytes() for suffix in (".hdf5", ".mp4")}


def copy_episode(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    for suffix, data in sample().items():
        path.with_suffix(suffix).write_bytes(data)
    return path


def test_one_way_tasks_take_the_first_description(world, tmp_path, imported):
    attributes = {"llm_description": "Cut it.", "llm_description2": "?", "llm_type": "static"}
    write_episode(world, tmp_path / "0.hdf5", attributes=attributes)
    assert imported(EgoDex(source=tmp_path))[0]["0"].caption == "Cut it."


def test_a_hand_of_low_confidence_is_missing(world, tmp_path, imported):
    write_episode(world, tmp_path / "0.hdf5", confidence=0.05)
    recording = imported(EgoDex(source=tmp_path))[0]["0"]
    assert np.isnan(recording.joints_m[:, 0]).all()
    assert np.isfinite(recording.joints_m[:, 1]).all()


def test_a_bad_episode_is_named_and_the_others_are_imported(tmp_path, imported):
    source = tmp_path / "set"
    for number in range(6):
        copy_episode(source / f"{number}.hdf5")
    data = (source / "1.hdf5").read_bytes()
    (source / "1.hdf5").write_bytes(data[: len(data) // 3])
    (source / "2.mp4").unlink()
    with h5py.File(source / "3.hdf5", "a") as file:
        file["transforms/camera"][2] = np.nan
    done, problems = imported(EgoDex(source=source))
    assert list(done) == ["0", "4", "5"]
    assert "not a readable HDF5 file" in problems["1"]
    assert "2.mp4 cannot be read" in problems["2"]
    assert "frame 2 is not a rigid" in problems["3"]


EMPTY = {"intrinsics": "camera/intrinsic", "left": "transforms/leftHand",
         "right": "transforms/rightRingFingerTip", "no hand": "confidences/rightHand"}  # fmt: skip


@pytest.mark.parametrize("kept", [None, 0, 5])
@pytest.mark.parametrize("part", EMPTY)
def test_a_part_that_is_missing_or_empty_is_unknown_and_the_rest_is_read(
    world, tmp_path, imported, caplog, part, kept
):
    name = EMPTY[part]
    with h5py.File(copy_episode(tmp_path / "0.hdf5"), "a") as file:
        values = file[name][:kept]
        del file[name]
        if kept is not None:
            file[name] = values if part != "intrinsics" else values[:0]
    recording = imported(EgoDex(source=tmp_path))[0]["0"]
    assert (recording.intrinsics_px is None) == (part == "intrinsics")
    given = np.isfinite(recording.joints_m).all(axis=(0, 2, 3))
    assert given.tolist() == [part != "left", part != "right"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses, atol=1e-6)
    assert (f"{name}: missing" in caplog.text) == (part != "no hand")


def test_intrinsics_of_zeros_are_unknown(tmp_path, imported):
    with h5py.File(copy_episode(tmp_path / "0.hdf5"), "a") as file:
        file["camera/intrinsic"][...] = 0
    assert imported(EgoDex(source=tmp_path))[0]["0"].intrinsics_px is None


def replace(path, name, make):
    with h5py.File(path, "a") as file:
        del file[name]
        make(file)


HOSTILE = {
    "external link": lambda f: f.__setitem__("transforms/camera", h5py.ExternalLink("b.h5", "/x")),
    "soft link": lambda f: f.__setitem__("transforms/camera", h5py.SoftLink("/transforms/hip")),
    "another file": lambda f: f["transforms"].create_dataset(
        "camera", (12, 4, 4), "f4", external=[("/etc/passwd", 0, 768)]
    ),
    "virtual": lambda f: f["transforms"].create_virtual_dataset(
        "camera", h5py.VirtualLayout((12, 4, 4), "f4")
    ),
    "absurd size": lambda f: f["transforms"].create_dataset(
        "camera", (1 << 40, 4, 4), "f4", chunks=(1, 4, 4)
    ),
    "wrong shape": lambda f: f["transforms"].create_dataset("camera", (12, 3, 4), "f4"),
    "objects": lambda f: f["transforms"].create_dataset("camera", (12, 4, 4), h5py.string_dtype()),
    "group": lambda f: f.create_group("transforms/camera"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_file_is_refused(tmp_path, imported, kind):
    copy_episode(tmp_path / "0.hdf5")
    replace(tmp_path / "0.hdf5", "transforms/camera", HOSTILE[kind])
    done, problems = imported(EgoDex(source=tmp_path))
    assert not done
    assert "transforms/camera" in problems["0"]


def test_a_filter_that_needs_a_plugin_is_refused(tmp_path, imported):
    copy_episode(tmp_path / "0.hdf5")

    def make(file):
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((12, 4, 4))
        plist.set_filter(32015, h5py.h5z.FLAG_OPTIONAL, ())
        space = h5py.h5s.create_simple((12, 4, 4))
        h5py.h5d.create(file["transforms"].id, b"camera", h5py.h5t.IEEE_F32LE, space, plist)

    replace(tmp_path / "0.hdf5", "transforms/camera", make)
    assert "filter 32015" in imported(EgoDex(source=tmp_path))[1]["0"]


def test_joints_of_another_world_are_refused(world, tmp_path, imported):
    world.joints[..., 1] += 50
    write_episode(world, tmp_path / "0.hdf5")
    assert "one world" in imported(EgoDex(source=tmp_path))[1]["0"]
