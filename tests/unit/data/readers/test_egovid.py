"""EgoVid-5M: the direction of its poses is decided from the video; captions and spans are right."""

import numpy as np
import pytest

from egosim_jax.data.readers.egovid import EgoVid
from egosim_jax.geometry import invert
from egosim_jax.types import InputError
from tests.captures import World

UUID = "0a47c74a-dad9-42d5-b937-0f375490f034"


@pytest.fixture(scope="module")
def plane():
    world = World(frames=20, height=240, width=320)
    world.render_plane()
    return world


def write_set(root, world, *, poses=None, video=None, span=(0, 20)):
    video_id = f"{UUID}_{span[0]}_{span[1]}"
    world.write_video(root / f"{video or video_id}.mp4")
    root.joinpath("egovid-val.csv").write_text(
        "video_id,frame_num,name,llava_cap,noun_cls\n"
        f'{video_id},20,cut onion,"The wearer cuts an onion, slowly.","onion, knife"\n'
        "another_0_20,20,not downloaded,,\n"
    )
    folder = root / "poses" / video_id
    folder.mkdir(parents=True)
    intrinsics = world.intrinsics.copy()
    intrinsics[:2] *= 540 / world.height
    np.save(folder / "intri.npy", intrinsics)
    np.save(folder / "fused_pose.npy", world.poses if poses is None else poses)
    return video_id


@pytest.mark.parametrize("inverted", [False, True])
def test_the_direction_of_poses_is_decided_by_epipolar_geometry(
    plane, tmp_path, imported, inverted
):
    poses = invert(plane.poses) if inverted else plane.poses
    video_id = write_set(tmp_path / "set", plane, poses=poses)
    done, problems = imported(EgoVid(source=tmp_path / "set"))
    assert not problems
    recording = done[video_id]
    direction = "world_to_camera" if inverted else "camera_to_world"
    assert recording.provenance["poses"] == direction
    np.testing.assert_allclose(recording.world_from_camera, plane.poses, atol=1e-9)
    np.testing.assert_allclose(recording.intrinsics_px, plane.intrinsics, atol=1e-9)
    assert recording.caption == "The wearer cuts an onion, slowly."
    assert recording.names == ("onion", "knife")
    assert not recording.metric


def test_poses_that_do_not_fit_the_video_stay_unknown(plane, tmp_path, imported):
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 1, 3] = 0.05 * np.arange(20)
    video_id = write_set(tmp_path / "set", plane, poses=poses)
    recording = imported(EgoVid(source=tmp_path / "set"))[0][video_id]
    assert recording.world_from_camera is None
    assert "no reading clearly fits" in recording.provenance["poses"]
    assert recording.intrinsics_px is not None


@pytest.mark.parametrize("count", [19, 16, 15, 13, 10])
def test_of_more_frames_than_poses_those_with_poses_are_used(
    plane, tmp_path, imported, caplog, count
):
    video_id = write_set(tmp_path / "set", plane, poses=plane.poses[:count])
    recording = imported(EgoVid(source=tmp_path / "set"))[0][video_id]
    np.testing.assert_allclose(recording.world_from_camera, plane.poses[:count], atol=1e-9)
    assert recording.frames == count
    assert f"the first {count} of both are used" in caplog.text


@pytest.mark.parametrize("count", [16, 15, 13, 10, 30])
def test_poses_of_another_rate_stay_unknown(plane, tmp_path, imported, caplog, count):
    poses = plane.poses[np.arange(count) * 20 // count]
    video_id = write_set(tmp_path / "set", plane, poses=poses)
    recording = imported(EgoVid(source=tmp_path / "set"))[0][video_id]
    assert (recording.world_from_camera, recording.frames) == (None, 20)
    assert recording.provenance["poses"] == "unknown: at another rate they fit the video better"
    assert f"{count} poses for 20 frames stay unknown" in caplog.text
    assert "are used" not in caplog.text


@pytest.mark.parametrize("damage", ["missing", "empty"])
def test_poses_without_intrinsics_stay_unknown(plane, tmp_path, imported, damage):
    video_id = write_set(tmp_path / "set", plane)
    path = tmp_path / f"set/poses/{video_id}/intri.npy"
    path.unlink() if damage == "missing" else np.save(path, np.zeros((0, 3)))
    recording = imported(EgoVid(source=tmp_path / "set"))[0][video_id]
    assert (recording.world_from_camera, recording.frames) == (None, 20)
    assert recording.names == ("onion", "knife")


def test_without_poses_the_rest_is_read(plane, tmp_path, imported, caplog):
    video_id = write_set(tmp_path / "set", plane)
    (tmp_path / f"set/poses/{video_id}/fused_pose.npy").unlink()
    recording = imported(EgoVid(source=tmp_path / "set"))[0][video_id]
    assert (recording.world_from_camera, recording.frames) == (None, 20)
    assert recording.caption == "The wearer cuts an onion, slowly."
    np.testing.assert_allclose(recording.intrinsics_px, plane.intrinsics, atol=1e-9)
    assert "The poses stay unknown" in caplog.text


@pytest.mark.parametrize(
    "poses",
    [np.zeros((20, 4, 4), complex), np.zeros((20, 3, 4)), np.full((20, 4, 4), np.nan), "object"],
)
def test_hostile_poses_are_refused(world, tmp_path, imported, poses):
    video_id = write_set(tmp_path / "set", world)
    path = tmp_path / f"set/poses/{video_id}/fused_pose.npy"
    if isinstance(poses, str):
        np.save(path, np.array([{}], object), allow_pickle=True)
    else:
        np.save(path, poses)
    done, problems = imported(EgoVid(source=tmp_path / "set"))
    assert not done
    assert "fused_pose.npy" in problems[video_id]


def test_a_folder_without_videos_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("video_id\n")
    with pytest.raises(InputError, match="--videos"):
        list(EgoVid(source=tmp_path).find())
