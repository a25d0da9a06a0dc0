"""Ranking of candidate actions."""

import json

import numpy as np
import pytest
from PIL import Image

from egosim_jax.cli.__main__ import main
from egosim_jax.generation import rank
from egosim_jax.generation.batch import BatchJob
from egosim_jax.perception.networks.xclip import prepare
from egosim_jax.types import InputError
from tests import shown


def test_the_candidate_with_the_highest_mean_score_is_first():
    found = rank.order({"a": (0.1, 0.3), "b": (0.5, 0.1), "c": (0.0, 0.0)})
    assert [(one.name, one.rank) for one in found] == [("b", 1), ("a", 2), ("c", 3)]
    assert found[0].score == pytest.approx(0.3)


@pytest.fixture(autouse=True)
def generated_clips_show_the_hands(monkeypatch):
    shown.show_hands(monkeypatch)


def candidates(folder, **grays):
    return shown.windows_of_hands(folder, grays)


def jobs(out):
    return [
        BatchJob(model=shown.MODEL, out=out / str(s), weights=None, seed=s, skip_existing=True)
        for s in (0, 1)
    ]


def brightness(video):
    return float(video[-1].mean())


def test_candidates_are_generated_by_every_seed_ranked_and_reported(tmp_path, capsys):
    windows = candidates(tmp_path / "clips", dark=40, bright=200, gray=120)
    ranked = rank.rank(jobs(tmp_path / "out"), windows, brightness)
    assert [(one.name, one.rank) for one in ranked] == [("bright", 1), ("gray", 2), ("dark", 3)]
    for one, gray in zip(ranked, (200, 120, 40), strict=True):
        assert one.scores == pytest.approx((gray, gray), abs=4)  # a score of each seed
    capsys.readouterr()
    rank.report(ranked, tmp_path, goal="light", measure="brightness")
    found = json.loads((tmp_path / "ranking.json").read_text("utf-8"))
    assert (found["goal"], found["measure"], found["best"]) == ("light", "brightness", "bright")
    assert [row["name"] for row in found["candidates"]] == ["bright", "gray", "dark"]
    assert [row["scores"] for row in found["candidates"]] == [list(one.scores) for one in ranked]
    table = capsys.readouterr().out
    assert table.index("bright") < table.index("gray") < table.index("dark")


def test_a_candidate_whose_hands_were_corrected_is_not_ranked_by_its_old_clip(tmp_path):
    out, windows = tmp_path / "out", candidates(tmp_path / "clips", a=120, b=200)
    first = rank.rank(jobs(out), windows, brightness)
    assert [one.name for one in first] == ["b", "a"]
    assert rank.rank(jobs(out), windows, brightness) == first
    candidates(tmp_path / "clips", a=120, b=40)
    with pytest.raises(InputError, match=r"b\.mp4 exists .* another conditions_sha256"):
        rank.rank(jobs(out), windows, brightness)
    for seed in "01":
        (out / seed / "b.mp4").unlink()
    again = rank.rank(jobs(out), windows, brightness)
    assert [one.name for one in again] == ["a", "b"]
    assert rank.rank(jobs(out), windows, brightness) == again


def test_a_video_that_ends_at_the_goal_scores_highest():
    rng = np.random.default_rng(0)
    goal, other = rng.integers(0, 256, (2, 64, 64, 3), np.uint8)
    score = rank.by_image(goal, (64, 64))
    assert score(np.stack([other, goal])) == pytest.approx(0, abs=1e-6)
    assert score(np.stack([goal, other])) < -0.1
    half = rank.by_image(goal, (32, 32))
    assert half(np.stack([other, goal])[:, ::2, ::2]) < 0  # of the goal at the video's size


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ((), "not neither"),
        (("--goal-text", "a cup", "--goal-image", "goal.png"), "not both"),
        (("--goal-text", "a cup"), "folder of an X-CLIP model"),
        (("--goal-image", "goal.png", "--xclip", "clip"), "compared by LPIPS, not by X-CLIP"),
        (("--goal-image", "goal.png", "--seeds", "0"), "--seeds must be at least 1, not 0"),
        (("--goal-image", "goal.png", "--seed", "-1"), "--seed must be a whole number from 0"),
    ],
)
def test_a_ranking_that_cannot_be_is_refused_before_anything_is_generated(
    goal, message, tmp_path, capsys
):
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "goal.png")
    given = [str(tmp_path / part) if part == "goal.png" else part for part in goal]
    command = ["rank", "--config", "tabletop", "--actions", "a.csv", "--out", str(tmp_path / "out")]
    assert main([*command, *given]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_a_text_is_compared_with_frames_from_all_of_the_video():
    video = np.zeros((17, 30, 60, 3), np.uint8)
    video[:, :, :12] = 255  # cut off by the crop
    video[8] = 128
    pixels = prepare(video, frames=3, size=20, mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
    assert pixels.shape == (3, 3, 20, 20)
    np.testing.assert_allclose(pixels[[0, 2]], -1)
    np.testing.assert_allclose(pixels[1], 128 / 127.5 - 1, atol=1e-6)
