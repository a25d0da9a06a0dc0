"""Episodes of LeRobot datasets: our own export, and others with hands and cameras."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from egosim_jax.annotate.lerobot_episode import episode_from_lerobot
from egosim_jax.data.lerobot_writer import HANDS, POSES
from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.single import WorldEnv
from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server import dataset_export
from egosim_jax.interactive.server.store import Store
from egosim_jax.state import snapshot
from egosim_jax.types import InputError
from tests.painted import VIDEO, painted

SIDES = ["left", "right"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A dataset of a session with two hands and a camera that moves, and its two actions."""
    folder = tmp_path_factory.mktemp("dataset")
    store = Store(folder / "sessions", painted(), Limits())
    session = store.create({"seed": 3, "actions": {"sides": SIDES, "camera": True}})
    for number, prompt in ((1, "Wave."), (2, "Clap.")):
        rows = session.actions.rest + 0.01 * np.arange(1, 5)[:, None] * number
        rows = np.clip(rows, *session.actions.bounds)
        step = {"session": session.id, "step_id": number, "actions": rows, "prompt": prompt}
        store.step(step).result()
    ((opened,), _) = dataset_export.open_sessions(folder / "sessions")
    dataset_export.to_lerobot([opened], folder / "set")
    store.close()
    return folder / "set", [opened.action(number) for number in (1, 2)]


def test_an_exported_session_is_read_as_the_same_episode(recorded):
    folder, actions = recorded
    episode = episode_from_lerobot(folder, 0, VIDEO)
    for found, action in zip(episode.actions, actions, strict=True):
        np.testing.assert_array_equal(found.joints_m, action.joints_m)
        np.testing.assert_array_equal(
            found.cameras.world_from_camera, action.cameras.world_from_camera
        )
        np.testing.assert_allclose(found.cameras.intrinsics_px, action.cameras.intrinsics_px)
        assert (found.prompt, found.kind) == (action.prompt, action.kind)
    start = painted().start(3, ActionSpec(sides=tuple(SIDES), camera=True))
    assert snapshot.fingerprint(episode.state) == snapshot.fingerprint(start.state)
    np.testing.assert_array_equal(episode.first_frame, start.first_frame)
    env = WorldEnv(painted())
    info = env.reset(options={"episode": episode})[1]
    assert info["state_sha256"] == snapshot.fingerprint(start.state)


def test_an_episode_is_read_at_another_rate_and_size_and_in_another_scene(recorded):
    state = replace(painted().start(4, ActionSpec()).state, step=0)
    video = replace(VIDEO, fps=4, frames=3, height=64, width=96)
    episode = episode_from_lerobot(recorded[0], 0, video, state=state, clips=1)
    np.testing.assert_array_equal(episode.actions[0].joints_m, recorded[1][0].joints_m[::2])
    assert (episode.shape, episode.first_frame) == ((3, 64, 96), None)
    assert snapshot.fingerprint(episode.state) == snapshot.fingerprint(state)


def test_a_camera_that_never_moves_is_said(recorded, tmp_path, caplog):
    episode_from_lerobot(recorded[0], 0, VIDEO)
    assert not caplog.text
    shutil.copytree(recorded[0], tmp_path / "set")
    path = next((tmp_path / "set/data").rglob("*.parquet"))
    table = pq.read_table(path)
    column = table.schema.get_field_index(POSES)
    poses = pa.array([table[POSES][0].as_py()] * len(table), table[POSES].type)
    pq.write_table(table.set_column(column, POSES, poses), path)
    episode_from_lerobot(tmp_path / "set", 0, VIDEO)
    assert "Episode 0 of" in caplog.text
    assert "the camera is at rest, or its poses are placeholders" in caplog.text


def test_rows_are_taken_by_their_time_stamps(recorded, tmp_path):
    """Stamps that are twice as far apart halve the rate, whatever info.json says."""
    shutil.copytree(recorded[0], tmp_path / "set")
    path = next((tmp_path / "set/data").rglob("*.parquet"))
    table = pq.read_table(path)
    column = table.schema.get_field_index("timestamp")
    stamps = pa.array([2 * t for t in table["timestamp"].to_pylist()], table["timestamp"].type)
    pq.write_table(table.set_column(column, "timestamp", stamps), path)
    episode = episode_from_lerobot(tmp_path / "set", 0, VIDEO, clips=1)
    frames = np.floor(np.arange(VIDEO.frames) / 2 + 0.5).astype(int)
    np.testing.assert_array_equal(episode.actions[0].joints_m, recorded[1][0].joints_m[frames])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"codebase_version": "v2.1"}, "LeRobot version 'v2.1'; supported are v3.0"),
        ({HANDS: None}, "has no feature observation.hands.joints_m"),
        ({"number": 7}, "no episode 7 among its 1"),
        ({"clips": 3}, "enough for 2 clips"),
        ({"scene": None}, "no scene of this episode"),
        ({"fps": 0}, "must be above 0"),
    ],
)
def test_a_dataset_without_what_an_episode_needs_is_refused(recorded, tmp_path, change, message):
    for name in ("data", "meta"):
        (tmp_path / name).mkdir()
    (tmp_path / "data" / "chunk-000").symlink_to(recorded[0] / "data" / "chunk-000")
    for path in (recorded[0] / "meta").iterdir():
        if "scene" not in change or path.name != "egosim":
            (tmp_path / "meta" / path.name).symlink_to(path)
    info = json.loads((recorded[0] / "meta" / "info.json").read_text())
    info |= {name: value for name, value in change.items() if name in info}
    if HANDS in change:
        del info["features"][HANDS]
    (tmp_path / "meta" / "info.json").unlink()
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(InputError, match=message):
        episode_from_lerobot(tmp_path, change.get("number", 0), VIDEO, clips=change.get("clips"))


def test_features_describe_hands_and_cameras(recorded):
    info = json.loads((recorded[0] / "meta" / "info.json").read_text())
    assert info["features"][HANDS] == {"dtype": "float64", "shape": [126], "names": None}
    assert info["features"][POSES]["shape"] == [16]
