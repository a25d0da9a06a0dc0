"""Records of videos for WRBench, by the rules of its evaluation (d1_sidecar_contract.py)."""

import json

import numpy as np
import pytest

from egosim_jax.experiments.wrbench import Record, write_manifest
from egosim_jax.io.video import probe_video
from egosim_jax.worlds.tabletop.attempts import turn_camera
from tests.scenes import pinhole

FRAMES = 9


def record(degrees=50.0):
    cameras = turn_camera(pinhole(1, 80.0, 32, 48), 0.0, np.radians(degrees), FRAMES)
    return Record(
        name="tabletop_300_unseen",
        frames=np.zeros((FRAMES, 32, 48, 3), np.uint8),
        fps=8,
        world_from_camera=cameras.world_from_camera,
        intrinsics_px=cameras.intrinsics_px,
        degrees=degrees,
        about={"model": "update, oracle", "expected_state": "The red box is where it was put."},
    )


def test_the_manifest_names_what_is_in_the_folder(tmp_path):
    write_manifest(tmp_path, [record().write(tmp_path)])
    (row,) = json.loads((tmp_path / "videos.json").read_text("utf-8"))
    assert row["video_id"] == "tabletop_300_unseen"
    assert row["model"] == "update, oracle"
    assert row["expected_state"] == "The red box is where it was put."
    assert probe_video(tmp_path / row["video_path"]).frames == FRAMES
    poses = np.load(tmp_path / row["target_pose_path"], allow_pickle=False)
    assert poses.shape == (FRAMES, 4, 4)
    assert poses.dtype == np.float32
    trajectory = json.loads((tmp_path / row["camera_trajectory_path"]).read_text("utf-8"))
    assert np.array(trajectory["c2w"]) == pytest.approx(poses, abs=1e-6)
    assert np.shape(trajectory["intrinsics"]) == (FRAMES, 3, 3)


@pytest.mark.parametrize(("degrees", "direction"), [(50.0, "yaw_LR"), (-50.0, "yaw_RL")])
def test_the_control_is_what_the_contract_wants(degrees, direction, tmp_path):
    row = record(degrees).write(tmp_path)
    control = json.loads((tmp_path / f"{row['video_path']}.camera.json").read_text("utf-8"))
    assert row["camera_type"] == control["control_direction"] == direction
    assert control["target_role"] == "benchmark_intended_control"
    assert control["target_coordinate_convention"] == "opencv_c2w"
    assert control["control_family"] == "rotation"
    assert control["control_profile"] == "diagnostic_50deg"
    assert control["evidence_level"] in {"benchmark_intent", "payload_audited"}
    assert control["yaw_peak_deg"] == 50
    needed = ("num_frames", "fps", "image_size", "fov", "trajectory_sampling_rule")
    assert all(control[name] for name in needed)
    assert control["fov"] == pytest.approx(np.degrees(2 * np.arctan(24 / 80)))
