"""Recorded sessions as data."""

import io
import json
import os
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image

from egosim_jax.cli.export import Export
from egosim_jax.data.shards import ShardReader
from egosim_jax.interactive.server import dataset_export
from egosim_jax.interactive.server.store import Limits, Store
from egosim_jax.io.untrusted.parquet import read_parquet
from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import WAN_GRID, InputError
from tests.painted import VIDEO, painted

LOADED = """
import json, sys, numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
found = LeRobotDataset("egosim/test", root=sys.argv[1])
items = [found[n] for n in range(len(found))]
frames = np.stack([(x["observation.images.ego"].numpy() * 255).round() for x in items])
np.savez(sys.argv[2], frames=frames.astype(np.uint8).transpose(0, 2, 3, 1),
    actions=np.stack([x["action"].numpy() for x in items]),
    tasks=[x["task"] for x in items], episodes=found.num_episodes)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two sessions: one closed and kept with two steps, a reset and one step; one empty."""
    folder = tmp_path_factory.mktemp("recorded") / "sessions"
    store = Store(folder, painted(), Limits())
    session = store.create({"seed": 3, "session": "one"})
    store.create({"seed": 3, "session": "empty"})
    rows = session.actions.rest + 0.02 * np.eye(7)[1][None]
    for number in (1, 2, 3):
        if number == 3:
            store.reset({"session": "one", "seed": 4}).result()
        store.step({"session": "one", "step_id": number, "actions": rows * 1.0}).result()
    store.remove({"session": "one", "keep": True}).result()
    store.close()
    return folder


def expected(folder):
    """Frames and actions of both episodes."""
    ((session,), _) = dataset_export.open_sessions(folder)
    frames, actions = [], []
    for _, steps in session.runs():
        for number in steps:
            frames += list(session.load_result(number).frames[:-1])
            actions += list(session.rows(number)[1:])
        frames.append(session.load_result(steps[-1]).frames[-1])
        actions.append(actions[-1])
    return np.stack(frames), np.stack(actions).astype(np.float32)


def test_a_lerobot_dataset_has_the_frames_and_actions(folder, tmp_path):
    dataset_export.to_lerobot(dataset_export.open_sessions(folder)[0], tmp_path / "set")
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    frames, actions = expected(folder)
    per_clip = VIDEO.frames - 1
    assert (info["total_episodes"], info["total_frames"]) == (2, len(frames))
    tables = [
        read_parquet(path, ["action", "observation.images.ego", "index"])
        for path in sorted((tmp_path / "set" / "data").rglob("*.parquet"))
    ]
    assert [len(table["index"]) for table in tables] == [2 * per_clip + 1, per_clip + 1]
    images = [p["bytes"] for table in tables for p in table["observation.images.ego"]]
    found = np.stack([np.asarray(Image.open(io.BytesIO(data))) for data in images])
    np.testing.assert_array_equal(found, frames)
    rows = np.concatenate([np.array(table["action"], np.float32) for table in tables])
    np.testing.assert_array_equal(rows, actions)


@pytest.mark.skipif(
    "LEROBOT_PYTHON" not in os.environ,
    reason="no LEROBOT_PYTHON: lerobot pins other versions",
)
def test_lerobots_own_loader_reads_the_same(folder, tmp_path):
    dataset_export.to_lerobot(dataset_export.open_sessions(folder)[0], tmp_path / "set")
    command = [os.environ["LEROBOT_PYTHON"], "-c", LOADED, str(tmp_path / "set"), "found.npz"]
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONPATH": ""}
    subprocess.run(command, check=True, cwd=tmp_path, env=environment)
    frames, actions = expected(folder)
    with np.load(tmp_path / "found.npz") as found:
        np.testing.assert_array_equal(found["frames"], frames)
        np.testing.assert_array_equal(found["actions"], actions)
        assert found["episodes"] == 2


def test_shards_have_a_clip_for_each_step(folder, tmp_path):
    sessions, _ = dataset_export.open_sessions(folder)
    dataset_export.to_shards(sessions, tmp_path / "shards", grid=WAN_GRID)
    records = list(ShardReader(tmp_path / "shards"))
    assert [record.metadata["video_id"] for record in records] == ["one_1", "one_2", "one_3"]
    np.testing.assert_array_equal(records[1].arrays["target"], sessions[0].load_result(2).frames)


@pytest.mark.slow
def test_a_recording_is_written(folder, tmp_path):
    dataset_export.to_rerun(dataset_export.open_sessions(folder)[0][0], tmp_path / "one.rrd")
    assert (tmp_path / "one.rrd").stat().st_size > 1000


def test_a_session_that_is_named_twice_is_exported_once(folder):
    assert [s.id for s in dataset_export.open_sessions(folder, ["one", "one"])[0]] == ["one"]


def test_an_unknown_session_is_refused(folder, tmp_path):
    with pytest.raises(InputError, match="no session 'two'"):
        dataset_export.open_sessions(folder, ["two"])
    with pytest.raises(InputError, match="no readable session with a committed step"):
        dataset_export.open_sessions(tmp_path)


def test_a_folder_with_files_is_not_replaced_by_a_dataset(folder, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty"):
        dataset_export.to_lerobot(dataset_export.open_sessions(folder)[0], tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("text", ["{", "{}"])
def test_a_damaged_session_does_not_keep_the_others_from_export(folder, tmp_path, text, capsys):
    copy = tmp_path / "sessions"
    shutil.copytree(folder, copy)
    shutil.copytree(folder / "one", copy / "bad")
    (copy / "bad" / "steps" / "2" / "request.json").write_text(text)
    assert Export(sessions=copy, out=tmp_path / "set").run() == ExitCode.PARTIAL
    assert "skipped session bad: " in capsys.readouterr().err
    assert json.loads((tmp_path / "set" / "meta" / "info.json").read_text())["total_episodes"] == 2
    with pytest.raises(InputError, match="Session bad cannot be exported"):
        dataset_export.open_sessions(copy, ["bad"])
