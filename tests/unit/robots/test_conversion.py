"""An episode of the tabletop world with a toy arm in place of its hand, and its dataset."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest

pytest.importorskip("mink")
import pyarrow.parquet as pq

from egosim_jax.cli.__main__ import main
from egosim_jax.cli.robot import Render
from egosim_jax.data.clips import check_clip, write_clips
from egosim_jax.data.metadata import read_metadata
from egosim_jax.rendering import reference
from egosim_jax.robots.conversion import (
    convert,
    export,
    report_of,
    triplets_of,
    up_frame,
    video_of,
)
from egosim_jax.robots.models import grip_of
from egosim_jax.robots.sources import of_episode
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_episode
from tests.unit.robots.toy import TOY, make_toy

SPEC = VideoSpec(frames=5, height=32, width=48, fps=4)


@pytest.fixture(scope="module")
def episode():
    return to_episode(list(make_sequence(4, spec=SPEC, clips=2)), fps=SPEC.fps)


@pytest.fixture(scope="module")
def converted(episode):
    return convert(of_episode(episode), make_toy())


def test_all_clips_have_the_robot_and_no_hand(episode, converted):
    assert video_of(converted).shape == (2 * SPEC.frames - 1, SPEC.height, SPEC.width, 3)
    assert sum(drawn.mask.sum() for drawn in converted.drawn) > 100
    for truth, background in zip(episode.ground_truth, converted.backgrounds, strict=True):
        assert background.hidden[truth.object_ids < 0].all()


def test_the_report_says_what_is_reached(converted):
    report = json.loads(json.dumps(report_of(converted)))
    (robot,) = report["robots"]
    track = converted.followers[0].placed.track
    assert robot["frames"] == 2 * SPEC.frames - 1
    assert robot["reached"] == track.reached.mean()
    assert len(robot["missed_frames"]) == (~track.reached).sum()
    assert robot["speed_in_limits"] <= 1 + 1e-6
    assert robot["least_distance_from_table_m"] > -0.002
    pixels = report["hand_pixels"]
    sources = ("from_state", "from_first_frame", "from_frames", "unknown")
    assert sum(pixels[name] for name in sources) == pixels["all"]


def test_the_table_is_found_below_the_hands(episode):
    action = episode.actions[0]
    pose = up_frame(episode.state, action.joints_m, action.cameras.world_from_camera[0])
    np.testing.assert_allclose(pose, np.eye(4), atol=2e-3)


def test_the_dataset_replays_the_path_of_the_grip(converted, tmp_path):
    export(converted, tmp_path / "data")
    info = json.loads((tmp_path / "data/meta/info.json").read_text())
    assert info["robot_type"] == "toy"
    names = info["features"]["observation.state"]["names"]
    table = pq.read_table(tmp_path / "data/data/chunk-000/file-000.parquet")
    rows, grips = (np.array(table[f"observation.{n}"].to_pylist()) for n in ("state", "grip"))
    assert rows.shape == (2 * SPEC.frames - 1, len(names))
    assert info["features"]["observation.grip"]["shape"] == [7]
    assert (grips[1:, 3:] * grips[:-1, 3:]).sum(axis=1).min() > 0  # no quaternion changes its sign
    robot = converted.followers[0].robot
    data = mujoco.MjData(robot.mj)
    openings = rows[:, names.index("gripper.opening")]
    assert 0 <= openings.min() < openings.max() <= 1
    for row, grip, opening in zip(rows, grips, openings, strict=True):
        q = robot.home
        q[robot.joint_at] = row[: len(TOY.joints)]
        data.qpos[:] = robot.open(q, opening * robot.largest_m)
        mujoco.mj_kinematics(robot.mj, data)
        np.testing.assert_allclose(grip_of(robot, data)[:3, 3], grip[:3], atol=1e-5)


def test_the_training_clips_have_the_skeletons_of_the_gripper(converted, tmp_path):
    path = write_clips(tmp_path, triplets_of(converted, "toy", reference), fps=SPEC.fps)
    rows = read_metadata(path)
    assert [(row.video_id, row.extra["robot"]) for row in rows] == [
        ("toy_1", "toy"),
        ("toy_2", "toy"),
    ]
    assert [check_clip(row, None) for row in rows] == [[], []]
    for row, triplet in zip(rows, triplets_of(converted, "toy", reference), strict=True):
        assert np.array_equal(triplet.hands.any(axis=(1, 2, 3)), np.ones(SPEC.frames, bool))
        assert np.array_equal(triplet.target, converted.drawn[rows.index(row)].frames)


def test_an_episode_without_ground_truth_is_refused(episode):
    bare = Episode(state=episode.state, actions=episode.actions, fps=episode.fps)
    with pytest.raises(InputError, match="no ground truth"):
        of_episode(bare)


def test_an_episode_without_hands_is_refused(episode):
    actions = tuple(
        replace(action, joints_m=np.full_like(action.joints_m, np.nan))
        for action in episode.actions
    )
    with pytest.raises(InputError, match="no hands"):
        convert(of_episode(replace(episode, actions=actions)), make_toy())


def test_robots_are_listed_and_others_refused(capsys, tmp_path):
    assert main(["robot", "list"]) == 0
    assert "panda" in capsys.readouterr().out
    given = ["robot", "render", str(tmp_path), "--robot", "r2d2", "--out", str(tmp_path / "out")]
    assert main(given) == 2
    assert "no robot 'r2d2'" in (said := capsys.readouterr().err)
    assert "Did you mean" in said


def test_a_stopped_command_leaves_nothing_and_is_repeated(monkeypatch, episode, tmp_path):
    monkeypatch.setattr("egosim_jax.robots.arms.arm_of", lambda _: TOY)
    monkeypatch.setattr("egosim_jax.robots.models.load_model", lambda _: make_toy())
    episode.save(tmp_path / "episode")
    given = ["robot", "render", str(tmp_path / "episode"), "--robot", "toy"]
    given += ["--out", str(tmp_path / "out")]
    with monkeypatch.context() as patch:
        patch.setattr("egosim_jax.io.run.write_json", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            Render(source=tmp_path / "episode", robot="toy", out=tmp_path / "out").run()
    assert [path.name for path in tmp_path.iterdir()] == ["episode"]
    assert main(given) == 0
    names = {"robot.mp4", "sheet.jpg", "report.json", "lerobot", "triplets"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names


def _interrupt(*_):
    raise KeyboardInterrupt


def test_a_missing_extra_is_named(monkeypatch, capsys, episode, tmp_path):
    monkeypatch.setattr("egosim_jax.robots.models.find_spec", lambda name: None)
    episode.save(tmp_path / "episode")
    given = ["robot", "render", str(tmp_path / "episode"), "--robot", "panda"]
    assert main([*given, "--out", str(tmp_path / "out")]) == 2
    assert "egosim-jax[robot]" in capsys.readouterr().err
