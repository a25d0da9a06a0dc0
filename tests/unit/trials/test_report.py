"""Tables and page of an evaluation."""

import json

import pytest

from egosim_jax.interactive.env.tasks import parse
from egosim_jax.interactive.env.true_world import TrueWorld
from egosim_jax.trials import report
from egosim_jax.trials.evaluation import Results, plan, run_all
from egosim_jax.trials.starts import read_starts
from tests.unit.trials.conftest import VIDEO, no_dataset, policy


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two policies with two tasks in two scenes."""
    folder, world = tmp_path_factory.mktemp("policies"), TrueWorld(video=VIDEO)
    starts = read_starts(["tabletop:0", "tabletop:2"], VIDEO, no_dataset)
    tasks = [parse("carry")]
    trials = plan(world, [policy("exact"), policy("never closes")], tasks, starts, seed=0)
    return folder, run_all(trials, world, folder, clips=1, batch=2)


def test_success_has_intervals_and_differences_are_paired(folder):
    summary = report.summary_of(folder[1], "exact")
    exact = summary["success"]["exact"]["all tasks"]
    assert (exact["mean"], exact["known"], exact["of"]) == (100, 2, 2)
    assert exact["low"] == pytest.approx(15.8, abs=0.1)
    gap = summary["differences"]["never closes"]["all tasks"]
    assert (gap["mean"], gap["better"], gap["worse"], gap["p"]) == (-100, 0, 2, 0.5)
    assert gap["low"] < 0 < gap["high"]


def test_tasks_have_separate_columns():
    trials = [
        {**TRIAL, "policy": p, "group": g, "task": g, "success": s}
        for p, g, s in [("a", "x", True), ("a", "y", False), ("b", "x", False)]
    ]
    summary = report.summary_of(Results(finished=trials), "a")
    assert summary["tasks"] == ["all tasks", "x", "y"]
    assert summary["success"]["b"]["y"] == {}
    assert summary["differences"]["b"]["all tasks"]["worse"] == 1


TRIAL = {"start": "s", "ended": "clips", "clips": 1, "held_frames": 2, "true_success": True}


def test_validity_counts_only_what_is_there():
    trials = [{**TRIAL, "policy": "a", "group": "x", "task": "x", "success": True}]
    summary = report.summary_of(Results(finished=trials, failed={"b": "no"}), "a")
    assert set(report.validity_of(summary)) == {"true_success", "refused", "held"}
    assert summary["validity"]["a"]["held"]["mean"] == 2
    assert summary["failed"] == {"b": "no"}


def test_the_tables_and_the_page_have_every_policy(folder, capsys):
    out, results = folder
    summary = report.summary_of(results, "exact")
    report.show(summary)
    printed = capsys.readouterr().out
    assert "100 [16, 100] (2 of 2)" in printed
    assert "never closes (better in 0, worse in 2, p = 0.5)" in printed
    json_path, page = report.write(out, summary, world="true", fps=8.0, clips=1)
    assert json.loads(json_path.read_text())["world"] == "true"
    text = page.read_text()
    assert text.count("<video") == 1
    assert "exact: success" in text
    assert "never closes: no success" in text


def test_no_page_is_written_for_no_clips(folder, tmp_path):
    summary = report.summary_of(folder[1], "exact")
    paths = list(report.write(tmp_path, summary, world="true", fps=8.0, clips=0))
    assert [path.name for path in paths] == ["report.json"]
