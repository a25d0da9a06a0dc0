"""AgiBot-World: the reading of the extrinsics is decided, grippers and captions are right."""

import json

import cv2
import h5py
import numpy as np
import pytest

from egosim_jax.data.readers.agibot import TOOL_M, AgiBot
from egosim_jax.geometry import invert
from egosim_jax.io.video import read_video
from tests.captures import quaternions

COEFFICIENTS = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}


def write_episode(
    root,
    world,
    *,
    episode="648642",
    inverted=False,
    flat=False,
    lens=None,
    parts=True,
    closing=False,
):
    """Write an episode whose grippers point down at the origin of the world."""
    task = "327"
    states = root / "proprio_stats" / task / episode
    camera = root / "parameters" / task / episode / "parameters" / "camera"
    videos = root / "observations" / task / episode / "videos"
    if flat:
        states = camera = videos = root / task / episode
    for folder in (states, camera, videos):
        folder.mkdir(parents=True, exist_ok=True)
    world.write_video(videos / "head_color.mp4")
    (fx, _, cx), (_, fy, cy), _ = world.intrinsics.tolist()
    intrinsic = {"fx": fx, "fy": fy, "ppx": cx, "ppy": cy} | (lens or COEFFICIENTS)
    (camera / "head_intrinsic_params.json").write_text(json.dumps({"intrinsic": intrinsic}))
    matrices = invert(world.poses) if inverted else world.poses
    entries = [
        {
            "extrinsic": {
                "rotation_matrix": m[:3, :3].tolist(),
                "translation_vector": m[:3, 3].tolist(),
            }
        }
        for m in matrices
    ]
    (camera / "head_extrinsic_params_aligned.json").write_text(json.dumps(entries))
    down = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # z of the flange is -y of the world
    count = world.frames
    positions = np.tile([[-0.1, TOOL_M, 0.0], [0.1, TOOL_M, 0.0]], (count, 1, 1))
    opening = np.linspace(40, 100, count)[:, None] * np.ones(2)
    with h5py.File(states / "proprio_stats.h5", "w") as file:
        file["timestamp"] = np.arange(count)
        file["state/end/position"] = positions
        file["state/end/orientation"] = np.tile(quaternions([down]), (count, 2, 1))
        file["state/effector/position"] = opening
        command = np.linspace(0, 1, count) if closing else np.linspace(1, 0, count)
        file["action/effector/position"] = command[:, None] * np.ones(2)
    if parts:
        actions = [
            {"start_frame": 0, "end_frame": 5, "action_text": "Pick the cup", "skill": "Pick"},
            {
                "start_frame": 5,
                "end_frame": count,
                "action_text": "Place the cup",
                "skill": "Place",
            },
        ]
        entry = {"episode_id": int(episode), "label_info": {"action_config": actions}}
        (root / "task_info").mkdir(exist_ok=True)
        (root / f"task_info/task_{task}.json").write_text(json.dumps([entry]))


@pytest.mark.parametrize("inverted", [False, True])
def test_the_reading_is_decided_by_projecting_the_grippers(world, tmp_path, imported, inverted):
    write_episode(tmp_path / "set", world, inverted=inverted)
    done, problems = imported(AgiBot(source=tmp_path / "set"))
    assert not problems
    recording = done["327-648642-001".replace("-", "_")]
    expected = "base_to_camera" if inverted else "camera_to_base"
    assert recording.provenance["extrinsics"] == expected
    assert "1.00" in recording.provenance["grippers_in_view"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses[5:], atol=1e-9)


def test_parts_are_recordings_with_captions_and_gripper_joints(world, tmp_path, imported):
    write_episode(tmp_path / "set", world)
    done, _ = imported(AgiBot(source=tmp_path / "set"))
    first, second = done["327_648642_000"], done["327_648642_001"]
    assert (first.caption, second.caption) == ("Pick the cup", "Place the cup")
    assert (first.frames, second.start, second.frames) == (5, 5, 7)
    world.assert_first(first)
    assert first.kind == "robot"
    flange, thumb, index = np.moveaxis(first.joints_m[0], 1, 0)
    np.testing.assert_allclose(flange, [[-0.1, TOOL_M, 0], [0.1, TOOL_M, 0]], atol=1e-9)
    np.testing.assert_allclose((thumb + index) / 2, [[-0.1, 0, 0], [0.1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(thumb - index, axis=1), 0.04, atol=1e-9)


def test_an_opening_that_follows_the_closing_command_is_reversed(world, tmp_path, imported):
    write_episode(tmp_path / "set", world, closing=True)
    recording = imported(AgiBot(source=tmp_path / "set"))[0]["327_648642_000"]
    width = np.linalg.norm(recording.joints_m[0, 0, 1] - recording.joints_m[0, 0, 2])
    assert width == pytest.approx(0.08)
    assert "closes" in recording.provenance["opening"]


def test_the_cameras_of_a_robot_with_hands_are_read_without_joints(world, tmp_path, imported):
    write_episode(tmp_path / "set", world)
    with h5py.File(next(tmp_path.rglob("*.h5")), "a") as file:
        del file["state/effector/position"]
        file["state/effector/position"] = np.zeros((world.frames, 12))
    recording = imported(AgiBot(source=tmp_path / "set"))[0]["327_648642_000"]
    assert recording.provenance["hands"] == "not grippers"
    assert recording.joints_m is None
    np.testing.assert_allclose(recording.world_from_camera, world.poses[:5], atol=1e-9)


def test_an_episode_in_one_folder_without_parts_is_one_recording(world, tmp_path, imported):
    write_episode(tmp_path / "set", world, flat=True, parts=False)
    done, problems = imported(AgiBot(source=tmp_path / "set"))
    assert not problems
    assert done["327_648642_000"].frames == world.frames


def test_an_undecided_reading_is_refused_unless_it_is_chosen(world, tmp_path, imported):
    world.poses[:] = np.eye(4)
    world.poses[:, 2, 3] = -0.6
    turned = world.poses.copy()
    turned[:, 2, 3] = 0.0  # its own inverse
    write_episode(tmp_path / "set", world)
    path = next(tmp_path.rglob("head_extrinsic_params_aligned.json"))
    entry = {"rotation_matrix": np.eye(3).tolist(), "translation_vector": [0, 0, 0]}
    path.write_text(json.dumps([{"extrinsic": entry}] * world.frames))
    with h5py.File(next(tmp_path.rglob("*.h5")), "a") as file:
        file["state/end/position"][...] += [0, 0, 0.5]
    _, problems = imported(AgiBot(source=tmp_path / "set"))
    assert all("cannot be decided" in problem for problem in problems.values())
    done, problems = imported(AgiBot(source=tmp_path / "set", extrinsics="camera_to_base"))
    assert not problems
    assert done["327_648642_000"].provenance["extrinsics_by"] == "user"


def test_a_distorting_lens_is_remapped(world, tmp_path, imported):
    write_episode(tmp_path / "set", world, lens=COEFFICIENTS | {"k1": -0.2})
    recording = imported(AgiBot(source=tmp_path / "set"))[0]["327_648642_001"]
    assert recording.video == tmp_path / "out/327_648642_001/video.mp4"
    assert recording.start == 0
    original = read_video(tmp_path / "set/observations/327/648642/videos/head_color.mp4").frames[5]
    k = recording.intrinsics_px
    expected = cv2.undistort(original, world.intrinsics, np.array([-0.2, 0, 0, 0, 0]), None, k)
    error = np.abs(recording.read_frames().frames[0].astype(int) - expected).mean()
    assert error < 2


def test_depth_files_are_found_by_frame(world, tmp_path, imported):
    write_episode(tmp_path / "set", world)
    folder = tmp_path / "set/observations/327/648642/depth"
    folder.mkdir()
    for frame in (5, 6, 8):
        depth = np.full((world.height, world.width), 100 * frame, np.uint16)
        cv2.imwrite(str(folder / f"head_depth_{frame:06d}.png"), depth)
    recording = imported(AgiBot(source=tmp_path / "set"))[0]["327_648642_001"]
    assert recording.read_depth(1)[0, 0] == pytest.approx(0.6)
    assert recording.read_depth(2) is None
    assert recording.read_depth(3)[0, 0] == pytest.approx(0.8)


CALIBRATION = {
    "no intrinsics": ("intrinsic_params", None),
    "empty intrinsics": ("intrinsic_params", {"intrinsic": {}}),
    "no extrinsics": ("extrinsic_params_aligned", None),
    "empty extrinsics": ("extrinsic_params_aligned", []),
}


@pytest.mark.parametrize("member", CALIBRATION)
@pytest.mark.parametrize("lens", [COEFFICIENTS, COEFFICIENTS | {"k1": -0.2}])
def test_a_missing_calibration_stays_unknown_and_the_rest_is_read(
    world, tmp_path, imported, caplog, member, lens
):
    name, content = CALIBRATION[member]
    write_episode(tmp_path / "set", world, lens=lens)
    path = next(tmp_path.rglob(f"head_{name}.json"))
    path.unlink() if content is None else path.write_text(json.dumps(content))
    (depth := tmp_path / "set/observations/327/648642/depth").mkdir()
    image = np.full((world.height, world.width), 500, np.uint16)
    cv2.imwrite(str(depth / "head_depth_000006.png"), image)
    done, problems = imported(AgiBot(source=tmp_path / "set"))
    assert not problems
    recording = done["327_648642_001"]
    assert (recording.caption, recording.frames) == ("Place the cup", 7)
    assert (recording.world_from_camera, recording.joints_m) == (None, None)
    assert not recording.metric
    assert (recording.intrinsics_px is None) == ("intrinsics" in member)
    assert recording.provenance["extrinsics"].startswith("unknown: no")
    assert "poses and grippers are unknown" in caplog.text
    if recording.video.name == "head_color.mp4":
        assert recording.read_depth(1)[0, 0] == pytest.approx(0.5)


def test_without_intrinsics_the_user_can_choose_the_reading(world, tmp_path, imported):
    write_episode(tmp_path / "set", world)
    next(tmp_path.rglob("head_intrinsic_params.json")).unlink()
    reader = AgiBot(source=tmp_path / "set", extrinsics="camera_to_base")
    recording = imported(reader)[0]["327_648642_001"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses[5:], atol=1e-9)
    assert recording.metric
    assert recording.intrinsics_px is None
    assert recording.joints_m.shape == (7, 2, 3, 3)


def test_without_openings_the_cameras_are_read(world, tmp_path, imported):
    write_episode(tmp_path / "set", world)
    with h5py.File(next(tmp_path.rglob("*.h5")), "a") as file:
        del file["state/effector"]
    recording = imported(AgiBot(source=tmp_path / "set"))[0]["327_648642_000"]
    assert recording.joints_m is None
    assert recording.provenance["hands"] == "unknown: no openings"
    np.testing.assert_allclose(recording.world_from_camera, world.poses[:5], atol=1e-9)


def test_damaged_episodes_are_named(world, tmp_path, imported, caplog):
    for number in range(4):
        write_episode(tmp_path / "set", world, episode=str(number), parts=False)
    base = tmp_path / "set/parameters/327"
    extrinsics = "parameters/camera/head_extrinsic_params_aligned.json"
    entries = json.loads((base / "0" / extrinsics).read_text())
    (base / "0" / extrinsics).write_text(json.dumps(entries[:11]))
    (base / "1" / extrinsics).write_text(json.dumps([{"extrinsic": 3}] * 12))
    (base / "2/parameters/camera/head_intrinsic_params.json").write_text(
        '{"intrinsic": {"fx": 1e9}}'
    )
    done, problems = imported(AgiBot(source=tmp_path / "set"))
    assert list(done) == ["327_0_000", "327_3_000"]
    assert done["327_0_000"].frames == 11
    assert "12 frames and 11 camera poses: the first 11" in caplog.text
    assert "rotation_matrix" in problems["327_1_000"]
    assert "fx" in problems["327_2_000"]
