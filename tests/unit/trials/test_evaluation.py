"""Trials of policies in a world."""

import json
from threading import Event

import numpy as np
import pytest

from egosim_jax.interactive.env.tasks import parse
from egosim_jax.interactive.server.session import Session
from egosim_jax.io.video import read_video
from egosim_jax.trials.evaluation import plan, run_all
from egosim_jax.trials.starts import read_starts
from egosim_jax.trials.trial import RESULT, VIDEO, Stopped
from egosim_jax.types import InputError
from tests.painted import painted
from tests.unit.trials import conftest
from tests.unit.trials.conftest import no_dataset, policy


def trials_of(world, policies, *tasks, starts="tabletop:0", seed=0):
    places = read_starts([starts], world.video, no_dataset)
    return plan(world, [policy(p) for p in policies], [parse(t) for t in tasks], places, seed=seed)


def test_scripted_policies_succeed_as_in_the_true_world(world, tmp_path):
    trials = trials_of(world, ["exact", "never closes"], "carry", starts="tabletop:0-1")
    results = run_all(trials, world, tmp_path, clips=2, batch=2)
    assert [(r["policy"], r["start"], r["success"]) for r in results.finished] == [
        ("exact", "tabletop:0", True),
        ("never closes", "tabletop:0", False),
        ("exact", "tabletop:1", True),
        ("never closes", "tabletop:1", False),
    ]
    exact, never = results.finished[:2]
    assert (exact["ended"], exact["clips"]) == ("success", 1)
    assert (never["ended"], never["clips"]) == ("policy", 1)
    assert "true_success" not in exact  # the world is the true one


def test_a_trial_ends_after_its_clips_or_with_the_policy(tmp_path):
    world = painted()
    trials = trials_of(world, ["still", "Counting"], "red box moved by 5 cm")
    still, counting = run_all(trials, world, tmp_path, clips=3, batch=2).finished
    assert (still["ended"], still["clips"], still["held_frames"]) == ("clips", 3, 0)
    assert (counting["ended"], counting["clips"], counting["held_frames"]) == ("policy", 2, 2)
    assert still["rewards"] == pytest.approx([-0.05] * 3)
    video = read_video(tmp_path / "trials" / still["id"] / VIDEO)
    assert len(video.frames) == 1 + 3 * (world.video.frames - 1)


def test_a_task_of_keeping_succeeds_after_the_last_clip(tmp_path):
    world = painted()
    trials = trials_of(world, ["still"], "red box untouched")
    (result,) = run_all(trials, world, tmp_path, clips=2, batch=1).finished
    assert (result["success"], result["ended"], result["clips"]) == (True, "clips", 2)
    assert result["true_success"]
    assert result["successes"] == [True, True]


def test_a_judge_of_a_module_sees_the_clip(tmp_path):
    world = painted()
    trials = trials_of(world, ["still"], f"be bright: {conftest.__name__}:bright")
    (result,) = run_all(trials, world, tmp_path, clips=2, batch=1).finished
    assert (result["success"], result["clips"]) == (True, 2)  # it ends no trial
    assert result["rewards"][0] > 10
    assert result["instruction"] == "be bright"
    assert "true_success" not in result


def test_an_action_out_of_bounds_ends_a_trial_without_success(tmp_path):
    world = painted()
    trials = trials_of(world, ["outside"], "red box untouched")
    (result,) = run_all(trials, world, tmp_path, clips=2, batch=1).finished
    assert not result["success"]
    assert result["ended"].startswith("refused: Row 0")
    assert len(read_video(tmp_path / "trials" / result["id"] / VIDEO).frames) == 1


def test_a_policy_that_fails_fails_its_trials_alone(tmp_path):
    world = painted()
    trials = trials_of(world, ["crashes", "still"], "red box untouched")
    results = run_all(trials, world, tmp_path, clips=1, batch=2)
    assert [result["policy"] for result in results.finished] == ["still"]
    ((name, reason),) = results.failed.items()
    assert name == "crashes, red box untouched, tabletop:0"
    assert "ZeroDivisionError: of the policy (conftest.py" in reason


def test_rows_of_another_length_end_the_run(tmp_path):
    world = painted()
    trials = trials_of(world, ["narrow"], "red box untouched")
    with pytest.raises(InputError, match="rows of 7 numbers"):
        run_all(trials, world, tmp_path, clips=1, batch=1)


def test_an_interrupted_trial_continues_with_the_same_clips(tmp_path, monkeypatch):
    world, stop = painted(), Event()
    (trial,) = trials_of(world, ["forward"], "red box moved by 5 cm")
    whole = trial.run(world, tmp_path / "whole", clips=3, stop=stop)
    asked = []

    def interrupted(observation):
        asked.append(observation["chunk"])
        if len(asked) == 2:
            stop.set()
        return conftest.forward(observation)

    monkeypatch.setattr(trial.policy, "_function", interrupted)
    with pytest.raises(Stopped):
        trial.run(world, tmp_path / "cut", clips=3, stop=stop)
    before = (tmp_path / "cut" / trial.id / "steps" / "1" / "info.json").stat().st_mtime_ns
    stop.clear()
    assert trial.run(world, tmp_path / "cut", clips=3, stop=stop) == whole
    assert asked == [0, 1, 0, 1, 2]
    after = (tmp_path / "cut" / trial.id / "steps" / "1" / "info.json").stat().st_mtime_ns
    assert before == after
    sessions = [Session(tmp_path / name / trial.id, world) for name in ("whole", "cut")]
    frames = [session.load_result(3).frames for session in sessions]
    np.testing.assert_array_equal(*frames)


def test_a_policy_that_decides_otherwise_begins_its_trial_again(tmp_path, monkeypatch):
    world, stop = painted(), Event()
    (trial,) = trials_of(world, ["forward"], "red box moved by 5 cm")
    trial.run(world, tmp_path, clips=1, stop=stop)
    (tmp_path / trial.id / RESULT).unlink()
    monkeypatch.setattr(trial.policy, "_function", conftest.still)
    result = trial.run(world, tmp_path, clips=2, stop=stop)
    session = Session(tmp_path / trial.id, world)
    assert (result["clips"], session.committed) == (2, 2)
    np.testing.assert_array_equal(session.rows(1)[0], session.rows(1)[-1])


def test_finished_trials_are_not_made_again(tmp_path, capsys):
    world = painted()
    both = trials_of(world, ["still", "Counting"], "red box untouched")
    first = run_all(both[:1], world, tmp_path, clips=1, batch=1).finished
    conftest.Counting.resets = 0
    again = run_all(both, world, tmp_path, clips=1, batch=1).finished
    assert again[0] == first[0]
    assert len(again) == 2
    assert json.loads((tmp_path / "trials" / both[1].id / RESULT).read_text())["clips"] == 1


def test_the_noise_depends_on_the_seed():
    seeds = [trials_of(painted(), ["still"], "red box untouched", seed=s)[0] for s in (0, 1)]
    assert [trial.start.seed for trial in seeds] == [0, 1000]


@pytest.mark.parametrize(
    ("policies", "task", "problem"),
    [
        (["still"], "blue whale untouched", "black cup, red box, green cone"),
        (["exact"], "red box untouched", "its only task is carry"),
    ],
)
def test_a_task_that_no_trial_can_have_is_refused(policies, task, problem):
    with pytest.raises(InputError, match=problem):
        trials_of(painted(), policies, task)
