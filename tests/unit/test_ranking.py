"""Ranking of candidate actions."""

import numpy as np
import pytest
from PIL import Image

from egosim_jax import ranking
from egosim_jax.cli.__main__ import main
from egosim_jax.perception.networks.xclip import prepare
from egosim_jax.types import InputError


def test_the_candidate_with_the_highest_mean_score_is_first():
    found = ranking.order({"a": (0.1, 0.3), "b": (0.5, 0.1), "c": (0.0, 0.0)})
    assert [(one.name, one.rank) for one in found] == [("b", 1), ("a", 2), ("c", 3)]
    assert found[0].score == pytest.approx(0.3)


def test_a_video_that_ends_at_the_goal_scores_highest():
    rng = np.random.default_rng(0)
    goal, other = rng.integers(0, 256, (2, 64, 64, 3), np.uint8)
    score = ranking.by_picture(goal)
    assert score(np.stack([other, goal])) == pytest.approx(0, abs=1e-6)
    assert score(np.stack([goal, other])) < -0.1
    assert score(np.stack([other, goal])[:, ::2, ::2]) < 0  # of the goal at the video's size


def test_a_text_without_a_network_is_refused_with_the_way_out():
    with pytest.raises(InputError, match=r"microsoft/xclip-base-patch32.*\(--goal-image\)"):
        ranking.by_text("a cup on the box", None)


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
