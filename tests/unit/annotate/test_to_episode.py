"""Episodes of annotated clips."""

import shutil

import numpy as np
import pytest

from egosim_jax.annotate.captions import RULE
from egosim_jax.annotate.clip import ANNOTATION
from egosim_jax.annotate.to_episode import episode_from
from egosim_jax.geometry import invert, project, transform
from egosim_jax.io.bounded import read_json
from egosim_jax.io.run import write_json
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import InputError, VideoSpec
from tests.unit.annotate.stubs import config, textured_video, write
from tests.unit.annotate.test_run import annotate

SMALL = VideoSpec(frames=5, height=32, width=48, fps=8)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("annotated")
    path = write(folder / "cup.mp4", textured_video(33))
    annotate([path], folder / "out", config())
    return folder / "out/cup"


def test_the_rest_of_the_video_becomes_actions(clip, tmp_path):
    episode = episode_from(clip, SMALL, clips=2)
    episode.save(tmp_path / "episode")
    found = Episode.load(tmp_path / "episode")
    assert (found.shape, found.fps, len(found.actions)) == ((5, 32, 48), 8, 2)
    first, second = (known.frames for known in found.ground_truth)
    assert np.array_equal(first[-1], second[0])  # frame 0 repeats the last one of the clip before
    assert found.first_frame is not None
    assert len(found.state.points_m) == 48 * 80


def test_joints_are_where_they_were_in_the_image(clip):
    episode = episode_from(clip, SMALL, clips=1)
    action = episode.actions[0]
    local = transform(invert(action.cameras.world_from_camera[0]), action.joints_m[0, 1])
    u, v = project(action.cameras.intrinsics_px, local)
    assert (u[0] + 0.5) / 48 == pytest.approx((79 / 2 + 0.5) / 80)
    assert (v[0] + 0.5) / 32 == pytest.approx((47 / 2 + 0.5) / 48)


def test_a_caption_by_the_rule_names_the_hands_that_a_clip_shows(clip, tmp_path):
    folder = tmp_path / "cup"
    shutil.copytree(clip, folder)
    about = read_json(folder / ANNOTATION)
    about["caption"] = {"source": RULE, "names": ["a cup"]}
    write_json(folder / ANNOTATION, about)
    arrays = dict(np.load(folder / "action.npz"))
    hands = np.full_like(arrays["joints_m"], np.nan)
    hands[:4, 0] = arrays["joints_m"][:4, 1]  # the next clip begins with frame 4
    arrays["joints_m"] = hands
    np.savez(folder / "action.npz", **arrays)
    first, second, *_ = episode_from(folder, SMALL).actions
    assert first.prompt == "The wearer's left hand moves in view of a camera near a cup."
    assert second.prompt == "A wearer looks at a scene without moving hands in view near a cup."
    about["caption"]["source"] = "--caption"
    write_json(folder / ANNOTATION, about)
    assert episode_from(folder, SMALL).actions[1].prompt == about["row"]["prompt"]


def test_all_clips_are_taken_by_default_and_more_are_refused(clip):
    assert len(episode_from(clip, SMALL).actions) == 4
    with pytest.raises(InputError, match="enough for 4 clips of 5 frames, not 5"):
        episode_from(clip, SMALL, clips=5)


def test_a_refused_clip_has_no_episode(tmp_path):
    path = write(tmp_path / "cup.mp4", textured_video(17))
    annotate([path], tmp_path / "out", config(refuse=True))
    with pytest.raises(InputError, match="not an accepted clip"):
        episode_from(tmp_path / "out/cup", SMALL)
