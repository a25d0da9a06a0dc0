"""Episodes by their commands: make from a seed or from files, check, show, simulate."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from egosim_jax.cli.__main__ import main
from egosim_jax.io.video import probe_video
from egosim_jax.rendering.skeleton import SKELETONS
from egosim_jax.simulation.episode import Episode
from egosim_jax.state.snapshot import save
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_episode

SPEC = VideoSpec(frames=9, height=64, width=96, fps=16)
"""Clips of the model `debug`."""


@pytest.fixture(scope="module")
def episode():
    return to_episode(list(make_sequence(3, spec=SPEC, clips=2)), fps=SPEC.fps)


def simulate(weights, out, *more):
    fixed = ["--config", "debug", "--weights", str(weights), "--out", str(out)]
    return main(["simulate", *fixed, *more])


def clips_of(out):
    """Return the clips of a report, without their latencies."""
    report = json.loads((out / "report.json").read_text("utf-8"))
    for clip in report["clips"]:
        assert 0 < clip.pop("first_frame_s") <= clip.pop("last_frame_s")
    return report["clips"]


def test_the_tabletop_world_and_an_episode_of_it_give_the_same_clips(weights, tmp_path, capsys):
    made = tmp_path / "episode.zip"
    options = ["--seed", "3", "--clips", "2", "--config", "debug"]
    assert main(["episode", "make", *options, "--out", str(made)]) == 0
    assert main(["episode", "check", str(made), "--config", "debug"]) == 0
    assert "2 clips of 9 frames of 96x64 at 16 fps, human hands" in capsys.readouterr().out
    common = ["--seed", "3", "--perception", "oracle"]
    assert simulate(weights, tmp_path / "world", *common, "--clips", "2") == 0
    assert simulate(weights, tmp_path / "episode", *common, "--episode", str(made)) == 0
    for name in ("clip_1/frames.npz", "clip_2/frames.npz", "state_2.ply"):
        assert (tmp_path / "world" / name).read_bytes() == (
            tmp_path / "episode" / name
        ).read_bytes()
    world, episode = (clips_of(tmp_path / name) for name in ("world", "episode"))
    assert world == episode


def test_an_episode_without_ground_truth_is_simulated_but_not_scored(weights, tmp_path, episode):
    bare = Episode(state=episode.state, actions=episode.actions, fps=episode.fps)
    bare.save(tmp_path / "bare")
    given = ["--episode", str(tmp_path / "bare")]
    assert simulate(weights, tmp_path / "run", *given, "--clips", "1") == 0
    clips = clips_of(tmp_path / "run")
    (clip,) = clips
    ((moved,),) = [clip.pop("moved")]
    assert clip == {"clip": 1, "action": episode.actions[0].prompt, "notes": []}
    assert moved["name"] in clip["action"]
    assert moved["moved_mm"] > 100
    assert probe_video(tmp_path / "run" / "clip_1_cmp.mp4").width == 3 * 96
    assert (tmp_path / "run" / "contact_sheet.png").exists()


def test_the_inputs_are_drawn_on_a_sheet(tmp_path, episode):
    episode.save(tmp_path / "episode")
    assert (
        main(["episode", "show", str(tmp_path / "episode"), "--out", str(tmp_path / "a.png")]) == 0
    )
    with Image.open(tmp_path / "a.png") as sheet:
        assert sheet.width == 6 * 96
        colors = np.asarray(sheet.convert("RGB"))
    drawn = (colors == color for color in SKELETONS["human"].colors)
    assert sum(where.all(axis=-1).sum() for where in drawn) > 20


def write_files(folder, episode):
    """Write the first action as .npz, the second as .json, the scene as an RGB-D image."""
    first, second = (
        {
            "world_from_camera": action.cameras.world_from_camera,
            "intrinsics_px": action.cameras.intrinsics_px,
            "joints_m": action.joints_m,
        }
        for action in episode.actions
    )
    np.savez(folder / "1.npz", **first)
    joints = second["joints_m"].tolist()
    joints[3][0] = None
    text = {name: value.tolist() for name, value in second.items()}
    text |= {"joints_m": joints, "prompt": "from the file"}
    (folder / "2.json").write_text(json.dumps(text))
    known = episode.ground_truth[0]
    image = np.repeat(np.repeat(known.frames[0], 2, axis=0), 2, axis=1)
    Image.fromarray(image).save(folder / "scene.png")
    np.savez(folder / "depth.npz", depth_m=np.repeat(np.repeat(known.depth_m[0], 2, 0), 2, 1))
    save(folder / "state", episode.state)


def make(folder, *more):
    files = ["--actions", str(folder / "1.npz"), str(folder / "2.json")]
    prompts = ["--prompts", "one", "two"]
    out = ["--config", "debug", "--out", str(folder / "out")]
    return main(["episode", "make", *files, *prompts, *out, *more])


def test_files_of_cameras_and_hands_become_an_episode(tmp_path, episode):
    write_files(tmp_path, episode)
    image = ["--image", str(tmp_path / "scene.png"), "--depth", str(tmp_path / "depth.npz")]
    assert make(tmp_path, *image) == 0
    made = Episode.load(tmp_path / "out")
    assert [action.prompt for action in made.actions] == ["one", "two"]
    assert np.isnan(made.actions[1].joints_m[3, 0]).all()
    for a, b in zip(made.actions, episode.actions, strict=True):
        np.testing.assert_array_equal(a.cameras.world_from_camera, b.cameras.world_from_camera)
    assert made.first_frame is not None
    assert made.first_frame.shape == (64, 96, 3)
    assert len(made.state.points_m) == np.isfinite(episode.ground_truth[0].depth_m[0]).sum() * 4
    assert make(tmp_path, "--state", str(tmp_path / "state")) == 2
    shutil.rmtree(tmp_path / "out")
    assert make(tmp_path, "--state", str(tmp_path / "state")) == 0
    assert len(Episode.load(tmp_path / "out").state.points_m) == len(episode.state.points_m)
