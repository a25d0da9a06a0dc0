"""Trials as LeRobot datasets."""

import json
from functools import partial

import numpy as np
import pyarrow.parquet as pq
import pytest

from egosim_jax.annotate.lerobot_episode import episode_from_lerobot
from egosim_jax.interactive.env import ActionSpec
from egosim_jax.interactive.env.tasks import parse
from egosim_jax.interactive.server.dataset_export import open_sessions
from egosim_jax.trials.evaluation import plan, run_all
from egosim_jax.trials.record import write_datasets
from egosim_jax.trials.starts import read_starts
from tests.painted import VIDEO, painted
from tests.unit.trials.conftest import no_dataset, policy

COLUMNS = ["next.reward", "next.success", "next.done", "action", "observation.state", "task_index"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Trials of two policies; one never gives an action that is allowed."""
    out, world = tmp_path_factory.mktemp("policies"), painted()
    starts = read_starts(["tabletop:0-1"], VIDEO, no_dataset)
    tasks = [parse("keep away: any untouched")]
    trials = plan(world, [policy("forward"), policy("outside")], tasks, starts, seed=0)
    finished = run_all(trials, world, out, clips=2, batch=2).finished
    return out, world, finished, list(write_datasets(out, finished, world))


def table_of(folder, episode):
    path = folder / f"data/chunk-000/file-{episode:03d}.parquet"
    return pq.read_table(path, columns=COLUMNS).to_pydict()


def test_a_dataset_has_reward_success_and_done_of_each_frame(made):
    _, _, finished, (folder,) = made  # none of a policy without a clip
    assert folder.name == "forward"
    info = json.loads((folder / "meta" / "info.json").read_text())
    trials = [trial for trial in finished if trial["policy"] == "forward"]
    assert info["total_episodes"] == len(trials) == 4
    kinds = {name: info["features"][name]["dtype"] for name in COLUMNS[:3]}
    assert kinds == {"next.reward": "float32", "next.success": "bool", "next.done": "bool"}
    assert info["features"]["next.done"]["shape"] == [1]
    table, per_clip = table_of(folder, 0), VIDEO.frames - 1
    count = 2 * per_clip + 1
    assert table["next.done"] == [False] * (count - 2) + [True] * 2
    assert table["next.success"] == table["next.done"]
    rewards = np.zeros(count)
    rewards[[per_clip - 1, 2 * per_clip - 1]] = trials[0]["rewards"]
    np.testing.assert_allclose(table["next.reward"], rewards, rtol=1e-6)
    moved = np.array(table["action"][count - 2]) - table["observation.state"][0]
    assert moved[1] == pytest.approx(0.04, abs=1e-6)


def test_its_tasks_are_the_instructions(made):
    folder = made[3][0]
    tasks = pq.read_table(folder / "meta" / "tasks.parquet").to_pydict()
    assert tasks["__index_level_0__"] == ["keep away"]
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    assert stats["next.done"]["max"] == [1.0]


def test_trials_are_sessions_that_can_be_exported(made):
    out, _, finished, _ = made
    sessions, damaged = open_sessions(out / "trials")
    assert {session.id for session in sessions} == {t["id"] for t in finished if t["clips"]}
    assert not damaged


def test_trials_begin_from_the_first_frames_of_a_dataset(made):
    _, world, finished, (folder,) = made
    read = partial(episode_from_lerobot, clips=1)
    (start,) = read_starts([f"{folder}:2"], VIDEO, read)
    begun = start.begin(world, ActionSpec())
    scene = world.start(1, ActionSpec())
    assert finished[4]["start"] == "tabletop:1"
    np.testing.assert_array_equal(begun.state.points_m, scene.state.points_m)
    np.testing.assert_allclose(
        begun.camera.world_from_camera, scene.camera.world_from_camera, atol=1e-6
    )


def test_a_dataset_is_written_again_only_for_other_trials(made):
    out, world, finished, (folder,) = made
    before = (folder / "meta" / "info.json").stat().st_ino
    assert list(write_datasets(out, finished, world)) == [folder]
    assert (folder / "meta" / "info.json").stat().st_ino == before
    fewer = [trial for trial in finished if trial["start"] == "tabletop:0"]
    list(write_datasets(out, fewer, world))
    assert json.loads((folder / "meta" / "info.json").read_text())["total_episodes"] == 2
