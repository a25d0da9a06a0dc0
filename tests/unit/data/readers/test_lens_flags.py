"""Keys and tags that change the meaning of a capture are applied or refused."""

import json

import numpy as np
import pytest
from PIL import Image

from egosim_jax.data.readers.colmap import Colmap
from egosim_jax.data.readers.nerfstudio import Nerfstudio
from tests.unit.data.readers import test_colmap, test_nerfstudio

FISHEYE = {"k1": 0.05, "k2": 0.01, "k3": 0.0, "k4": 0.0}


def read(world, root, imported, *, metric=False, **changes):
    test_nerfstudio.write_capture(root, world, **changes)
    done, problems = imported(Nerfstudio(source=root, fps=10.0, metric=metric))
    return done.get(root.name), problems.get(root.name)


@pytest.mark.parametrize("per_frame", [True, False])
def test_is_fisheye_is_the_fisheye_model(world, tmp_path, imported, per_frame):
    flag = {"is_fisheye": True}
    changes = {"frame_changes": flag} if per_frame else flag
    root = tmp_path / "a"
    test_nerfstudio.write_capture(root, world, **FISHEYE, **changes)
    written = json.loads((root / "transforms.json").read_text())
    del written["camera_model"]
    (root / "transforms.json").write_text(json.dumps(written))
    found = imported(Nerfstudio(source=root, fps=10.0))[0]["a"]
    named, _ = read(world, tmp_path / "b", imported, camera_model="OPENCV_FISHEYE", **FISHEYE)
    brown, _ = read(world, tmp_path / "c", imported, **FISHEYE | {"k3": 0.0})
    np.testing.assert_array_equal(found.intrinsics_px, named.intrinsics_px)
    frames = [recording.read_frames().frames.astype(int) for recording in (found, named, brown)]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert np.abs(frames[0] - frames[2]).max() > 20


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"is_fisheye": True}, "contradict"),
        ({"is_fisheye": "yes"}, "contradict"),
        ({"frame_changes": {"camera_model": "EQUIRECTANGULAR"}}, "EQUIRECTANGULAR"),
        ({"k4": 0.1}, "k4 is 0.1"),
        ({"k5": 0.1}, "k5 is 0.1"),
        ({"frame_changes": {"k6": -0.2}}, "k6 is -0.2"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.01}, "p1 is 0.01"),
        ({"camera_model": "FISHEYE624"}, "FISHEYE624"),
        ({"fisheye_crop_radius": 400.0}, "fisheye_crop_radius"),
        ({"camera_convention": "opencv"}, "camera_convention"),
        ({"coordinate_system": "OPENCV"}, "coordinate_system"),
        ({"distortion_params": [0.1, 0, 0, 0]}, "distortion_params"),
        ({"lens_mode": "ftheta"}, "lens_mode"),
        ({"from_mitsuba": True}, "from_mitsuba"),
        ({"frame_changes": {"rolling_shutter": [0, 0, 0.02, 0]}}, "rolling_shutter"),
        ({"pose_scale": 2}, "pose_scale"),
        ({"applied_scale": 0.5, "metric": True}, "applied_scale is 0.5"),
    ],
)
def test_what_is_not_applied_is_refused(world, tmp_path, imported, changes, message):
    recording, problem = read(world, tmp_path / "desk", imported, **changes)
    assert recording is None
    assert message in problem


@pytest.mark.parametrize(
    "changes",
    [
        {"applied_transform": np.eye(4)[:3].tolist(), "orientation_override": "none"},
        {"aabb_scale": 16, "camera_angle_x": 0.7, "sharpness": 41.2, "ply_file_path": "a.ply"},
        {"is_equirectangular": False, "rolling_shutter": [0, 0, 0, 0], "distortion_params": []},
        {"frame_changes": {"colmap_im_id": 3, "timestamp": 1.5, "mask_path": "m.png"}},
        {"camera_model": "SIMPLE_RADIAL"},
        {"applied_scale": 0.5},
        {"is_fisheye": False},
    ],
)
def test_what_changes_nothing_is_read(world, tmp_path, imported, changes):
    recording, problem = read(world, tmp_path / "desk", imported, **changes)
    assert problem is None
    np.testing.assert_allclose(recording.world_from_camera, world.poses, atol=1e-12)


def test_frames_of_two_models_are_refused(world, tmp_path, imported):
    root = tmp_path / "desk"
    test_nerfstudio.write_capture(root, world)
    written = json.loads((root / "transforms.json").read_text())
    written["frames"][3]["camera_model"] = "OPENCV_FISHEYE"
    (root / "transforms.json").write_text(json.dumps(written))
    problem = imported(Nerfstudio(source=root, fps=10.0))[1]["desk"]
    assert "several values of camera_model" in problem


def write_nerfstudio(root, world):
    test_nerfstudio.write_capture(root, world)
    return Nerfstudio(source=root, fps=10.0)


def write_colmap(root, world):
    test_colmap.write_model(root, world, binary=False)
    return Colmap(source=root, fps=10.0)


def retag(root, turn, *, pixels):
    exif = Image.Exif()
    exif[0x0112] = turn
    for path in (root / "images").iterdir():
        image = pixels(np.asarray(Image.open(path)))
        Image.fromarray(np.ascontiguousarray(image)).save(path, exif=exif)


@pytest.mark.parametrize("write", [write_nerfstudio, write_colmap])
@pytest.mark.parametrize("turn", [2, 3, 6, 8])
def test_poses_are_of_the_stored_pixels(world, tmp_path, imported, write, turn):
    reader = write(tmp_path / "room", world)
    retag(tmp_path / "room", turn, pixels=lambda image: image)
    recording = imported(reader)[0]["room"]
    world.assert_first(recording)
    np.testing.assert_allclose(recording.intrinsics_px, world.intrinsics, atol=1e-9)


@pytest.mark.parametrize("write", [write_nerfstudio, write_colmap])
@pytest.mark.parametrize(("turn", "times"), [(6, 1), (8, -1)])
def test_poses_of_turned_images_are_recognized_by_their_size(
    world, tmp_path, imported, write, turn, times
):
    reader = write(tmp_path / "room", world)
    retag(tmp_path / "room", turn, pixels=lambda image: np.rot90(image, times))
    world.assert_first(imported(reader)[0]["room"])
