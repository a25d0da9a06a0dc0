"""Clips that a robot can follow: annotated, simulated and served; other folders are refused."""

import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

pytest.importorskip("mink")

from egosim_jax.annotate.clip import ANNOTATION, MASKS, read_masks, write_masks
from egosim_jax.data.readers.lerobot import rate_of, read_info
from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server.store import Store
from egosim_jax.io.video import read_video
from egosim_jax.io.writing import write_video
from egosim_jax.robots.conversion import convert, export
from egosim_jax.robots.sources import open_source
from egosim_jax.simulation.rollout import load_clip
from egosim_jax.state import snapshot
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop import observation_of, to_episode
from tests.painted import painted
from tests.unit.annotate.stubs import config, textured_video, write
from tests.unit.annotate.test_run import annotate
from tests.unit.robots.toy import make_toy
from tests.unit.simulation.test_rollout import SPEC, clips, run


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Return a run of two clips, with the config that `egosim simulate` writes."""
    folder = tmp_path_factory.mktemp("simulated")
    to_episode(list(clips()), fps=SPEC.fps).save(folder / "episode")
    run(folder / "run")
    given = {"simulate": {"episode": str(folder / "episode")}}
    (folder / "run" / "config.json").write_text(json.dumps(given))
    return folder / "run"


def test_an_annotated_clip_has_its_masks_and_what_perception_finds(tmp_path):
    video = write(tmp_path / "cup.mp4", textured_video(9))
    settings = replace(config(), renderer="numpy")
    annotate([video], tmp_path / "out", settings)
    source = open_source(tmp_path / "out/cup")
    (truth,) = source.episode.ground_truth
    masks = read_masks(tmp_path / "out/cup" / MASKS, (9, 48, 80))
    assert masks.any()
    assert np.array_equal(truth.object_ids < 0, masks)
    assert (source.kind, source.episode.shape, source.episode.fps) == (
        "annotated clip", (9, 48, 80), 16,
    )  # fmt: skip


@pytest.mark.parametrize("rate", [Fraction(25, 2), Fraction(15, 2), Fraction(122, 5)])
def test_a_fractional_rate_is_kept_with_every_frame(tmp_path, rate):
    """Rounded, 12.5 frames a second lose a frame, and 7.5 repeat one."""
    video = write(tmp_path / "cup.mp4", textured_video(13), rate)
    annotate([video], tmp_path / "out", replace(config(), renderer="numpy"))
    source = open_source(tmp_path / "out/cup")
    recorded = read_video(tmp_path / "out/cup/video.mp4").frames
    assert np.array_equal(source.episode.ground_truth[0].frames, recorded)
    assert source.rate == rate
    converted = convert(source, make_toy())
    assert converted.fps == rate
    export(converted, tmp_path / "set")
    assert rate_of(read_info(tmp_path / "set", ["v3.0"])) == rate


def test_masks_of_a_long_clip_are_read(tmp_path):
    """300 frames of 832x464: a byte for each pixel would be refused as too large."""
    hands = np.zeros((300, 464, 830), bool)
    hands[5, 100:200, 7:300] = True
    write_masks(tmp_path / MASKS, hands)
    np.testing.assert_array_equal(read_masks(tmp_path / MASKS, hands.shape), hands)
    with pytest.raises(InputError, match="Annotate the clip again"):
        read_masks(tmp_path / MASKS, (300, 464, 840))


def test_a_refused_clip_says_why_it_has_no_cameras(tmp_path):
    video = write(tmp_path / "cup.mp4", textured_video(9))
    annotate([video], tmp_path / "out", config(refuse=True))
    with pytest.raises(InputError, match=r"no cameras and hands.*refused.*nothing to see"):
        open_source(tmp_path / "out/cup")


def test_a_simulation_has_its_generated_clips_and_what_it_perceived(simulated):
    source = open_source(simulated)
    for number, (truth, clip) in enumerate(
        zip(source.episode.ground_truth, clips(), strict=True), start=1
    ):
        shown = load_clip(simulated / f"clip_{number}/frames.npz", SPEC.fps).frames
        assert np.array_equal(truth.frames, shown)
        known = observation_of(clip)
        for target, motion in truth.motions.items():
            np.testing.assert_allclose(motion, known.motions[target], atol=1e-6)
    after = snapshot.load(simulated / "clip_1/state")
    assert np.array_equal(source.states[1].points_m, after.points_m)


def test_a_robot_follows_the_hands_of_a_simulation(simulated):
    source = open_source(simulated)
    found = convert(source, make_toy())
    for truth, background in zip(source.episode.ground_truth, found.backgrounds, strict=True):
        assert background.hidden[truth.object_ids < 0].all()
        assert np.isfinite(background.depth_m).mean() > 0.9


def test_a_simulation_of_a_changed_episode_is_refused(simulated, tmp_path):
    other = replace(clips()[0].state, step=1)
    episode = replace(to_episode(list(clips()), fps=SPEC.fps), state=other)
    episode.save(tmp_path / "episode")
    for name in ("journal.jsonl", "config.json"):
        text = (simulated / name).read_text()
        place = str(simulated.parent / "episode")
        (tmp_path / name).write_text(text.replace(place, str(tmp_path / "episode")))
    with pytest.raises(InputError, match="not the one that the run was made from"):
        open_source(tmp_path)


def test_a_session_has_its_steps_up_to_a_reset(tmp_path):
    store = Store(tmp_path / "sessions", painted(), Limits())
    session = store.create({"seed": 3, "session": "one"})
    rows = session.actions.rest + 0.02 * np.eye(7)[1][None]
    store.step({"session": "one", "step_id": 1, "actions": rows * 1.0}).result()
    frames = session.load_result(1).frames
    store.remove({"session": "one", "keep": True}).result()
    store.close()
    source = open_source(tmp_path / "sessions/one")
    assert source.kind == "session"
    assert np.array_equal(source.episode.ground_truth[0].frames, frames)
    with pytest.raises(InputError, match=r"1 clips or sessions.*one"):
        open_source(tmp_path / "sessions")


def test_other_folders_and_files_are_refused_with_a_list_of_sources(tmp_path):
    write_video(tmp_path / "clip.mp4", textured_video(5), 16)
    for path in (tmp_path, tmp_path / "clip.mp4"):
        with pytest.raises(InputError, match=r"egosim data annotate.*egosim simulate.*session"):
            open_source(path)
    with pytest.raises(InputError, match="does not exist"):
        open_source(tmp_path / "nothing")
    (tmp_path / "cup").mkdir()
    (tmp_path / "cup" / ANNOTATION).write_text("{}")
    with pytest.raises(InputError, match=r"1 clips or sessions.*cup"):
        open_source(tmp_path)
