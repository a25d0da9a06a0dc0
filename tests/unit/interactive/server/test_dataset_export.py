"""Recorded sessions as data."""

import io
import json
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from egosim_jax.cli.export import Export
from egosim_jax.data.shards import ShardReader
from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server import dataset_export, session
from egosim_jax.interactive.server.store import Store
from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import WAN_GRID, InputError, Motion, ObjectPath
from tests.painted import VIDEO, WRIST, PaintedWorld, Painter, painted
from tests.unit.interactive.server.served import step


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
        pq.read_table(path, columns=["action", "observation.images.ego", "index"]).to_pydict()
        for path in sorted((tmp_path / "set" / "data").rglob("*.parquet"))
    ]
    assert [len(table["index"]) for table in tables] == [2 * per_clip + 1, per_clip + 1]
    images = [p["bytes"] for table in tables for p in table["observation.images.ego"]]
    found = np.stack([np.asarray(Image.open(io.BytesIO(data))) for data in images])
    np.testing.assert_array_equal(found, frames)
    rows = np.concatenate([np.array(table["action"], np.float32) for table in tables])
    np.testing.assert_array_equal(rows, actions)


def test_shards_have_a_clip_for_each_step(folder, tmp_path):
    sessions, _ = dataset_export.open_sessions(folder)
    dataset_export.to_shards(sessions, tmp_path / "shards", grid=WAN_GRID)
    records = list(ShardReader(tmp_path / "shards"))
    assert [record.metadata["video_id"] for record in records] == ["one_1", "one_2", "one_3"]
    np.testing.assert_array_equal(records[1].arrays["target"], sessions[0].load_result(2).frames)


class Predicting(Painter):
    prior = "predicted"


def test_priors_are_exported_as_the_model_saw_them(tmp_path, monkeypatch):
    """The motion is made up: a step of a painted world moves nothing."""
    moved = np.eye(4)[None].repeat(VIDEO.frames, axis=0)
    moved[1:, 2, 3] = 0.1
    path = ObjectPath(motion=moved, causes=(), confidence=1.0)
    monkeypatch.setattr(
        "egosim_jax.simulation.simulator.predict",
        lambda state, action, fps: Motion(paths={int(state.object_ids.max()): path}),
    )
    world = PaintedWorld(generator=Predicting(), video=VIDEO, perception=None)
    store = Store(tmp_path / "sessions", world, Limits())
    made = store.create({"seed": 3, "session": "one"})
    store.step({"session": "one", "step_id": 1, "actions": made.actions.rest[None]}).result()
    store.close()
    sessions, _ = dataset_export.open_sessions(tmp_path / "sessions")
    dataset_export.to_shards(sessions, tmp_path / "shards", grid=WAN_GRID)
    (record,) = ShardReader(tmp_path / "shards")
    assert record.metadata["extra"]["prior_kind"] == "predicted"
    assert (record.arrays["prior"][1:] != record.arrays["prior"][0]).any()
    path = tmp_path / "sessions" / "one" / "session.json"
    settings = json.loads(path.read_text()) | {"prior": "guessed"}
    session._write_sealed(path, {n: v for n, v in settings.items() if n != session.SEAL})
    with pytest.raises(InputError, match="prior in its settings is 'guessed'"):
        dataset_export.open_sessions(tmp_path / "sessions", ["one"])


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


def edit(path, change):
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def replace_frames(path):
    frames = np.load(path)["frames"]
    np.savez(path, frames=frames[:, :-16])


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("steps/2/request.json", lambda v: v["rows"][2].__setitem__(0, float("nan"))),
        ("steps/2/request.json", lambda v: v["rows"][2].__setitem__(0, 9.0)),
        ("steps/2/request.json", lambda v: v["rows"][2].__setitem__(0, v["rows"][2][0] + 0.01)),
        ("steps/2/request.json", lambda v: v.update(prompt="other")),
        ("closed.json", lambda v: v["video"].update(fps=30)),
        ("closed.json", lambda v: v["video"].update(width=176)),
        ("closed.json", lambda v: v["actions"].update(sides=["left"])),
        ("steps/2/rollout/clip_1/frames.npz", None),
        ("steps/2/info.json", None),
        ("starts/0/start.json", lambda v: v["world_from_camera"][0].__setitem__(3, 0.1)),
        ("starts/0/start.json", lambda v: v.update(seed=5)),
        ("starts/0/start.json", lambda v: v.update(height=10**9)),
        ("starts/0/first_frame.png", None),
    ],
)
def test_an_edited_session_is_skipped(folder, tmp_path, file, change):
    copy = tmp_path / "sessions"
    shutil.copytree(folder, copy)
    shutil.copytree(folder / "one", copy / "bad")
    if change is not None:
        edit(copy / "bad" / file, change)
    elif file.endswith(".npz"):
        replace_frames(copy / "bad" / file)
    elif file.endswith(".png"):
        Image.new("RGB", (VIDEO.width, VIDEO.height)).save(copy / "bad" / file)
    else:
        (copy / "bad" / file).write_text("[]")
    readable, damaged = dataset_export.open_sessions(copy)
    assert ([s.id for s in readable], list(damaged)) == (["one"], ["bad"])


@pytest.mark.parametrize("value", [np.nan, 9.0])
def test_rows_out_of_bounds_are_skipped_even_if_their_hash_is_right(folder, tmp_path, value):
    shutil.copytree(folder, tmp_path / "sessions")
    path = tmp_path / "sessions" / "one" / "steps" / "2" / "request.json"
    fields = json.loads(path.read_text())
    del fields[session.SEAL]
    fields["rows"][2][0] = value
    session._write_sealed(path, fields)
    with pytest.raises(InputError, match="cannot be exported: Row 2"):
        dataset_export.open_sessions(tmp_path / "sessions", ["one"])


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("closed.json", lambda v: v.update(point_px=10**6)),
        ("closed.json", lambda v: v.update(point_px=2.5)),
        ("closed.json", lambda v: v["video"].update(fps=float("nan"))),
        ("closed.json", lambda v: v["video"].update(width=10**9)),
        ("steps/2/request.json", lambda v: v["rows"][2].__setitem__(0, v["rows"][2][0] + 0.01)),
        ("steps/2/request.json", lambda v: v["rows"][2].__setitem__(0, 10**400)),
        ("steps/2/request.json", lambda v: v.update(rows=3.0)),
        ("steps/2/request.json", lambda v: v.update(rows=[0.0, 1.0])),
        ("steps/2/request.json", lambda v: v.update(prompt=["x"])),
        ("steps/2/request.json", lambda v: v.update(prompt="Another prompt.")),
    ],
)
def test_an_edited_session_is_skipped_even_if_its_hash_is_right(folder, tmp_path, file, change):
    shutil.copytree(folder, tmp_path / "sessions")
    path = tmp_path / "sessions" / "one" / file
    fields = json.loads(path.read_text())
    del fields[session.SEAL]
    change(fields)
    session._write_sealed(path, fields)
    with pytest.raises(InputError, match="Session one cannot be exported") as refused:
        dataset_export.open_sessions(tmp_path / "sessions", ["one"])
    assert "Type-check" not in str(refused.value)


@pytest.mark.parametrize("file", ["starts", "starts/0/first_frame.png", "steps/2/info.json"])
def test_links_out_of_a_session_are_not_followed(folder, tmp_path, file):
    copy = tmp_path / "sessions" / "one"
    shutil.copytree(folder / "one", copy)
    (copy / file).rename(tmp_path / "secret")
    (copy / file).symlink_to(tmp_path / "secret")
    with pytest.raises(InputError, match="is a link to a file outside"):
        dataset_export.open_sessions(copy.parent, ["one"])
    shutil.copytree(folder / "one", tmp_path / "elsewhere" / "one")
    shutil.rmtree(copy)
    copy.symlink_to(tmp_path / "elsewhere" / "one")
    assert [s.id for s in dataset_export.open_sessions(copy.parent)[0]] == ["one"]


def test_a_lerobot_dataset_has_an_image_and_a_pose_of_each_camera(tmp_path):
    store = Store(tmp_path / "sessions", painted(), Limits())
    cameras = [{"name": "wrist", "mount": "right_wrist", "pose": WRIST.tolist()}]
    session = store.create({"seed": 3, "session": "one", "cameras": cameras})
    made = step(store, session, 1)
    step(store, store.create({"seed": 3, "session": "two"}), 1)
    store.close()
    sessions, _ = dataset_export.open_sessions(tmp_path / "sessions")
    with pytest.raises(InputError, match="2 sets of further cameras"):
        dataset_export.to_lerobot(sessions, tmp_path / "set")
    dataset_export.to_lerobot(sessions[:1], tmp_path / "set")
    (path,) = (tmp_path / "set" / "data").rglob("*.parquet")
    table = pq.read_table(path).to_pydict()
    images = [Image.open(io.BytesIO(p["bytes"])) for p in table["observation.images.wrist"]]
    np.testing.assert_array_equal(np.stack(list(map(np.asarray, images))), made.others["wrist"])
    poses = np.array(table["observation.camera.wrist.world_from_camera"]).reshape(-1, 4, 4)
    hands = session.actions.wrists(session.rows(1))[:, 0]
    np.testing.assert_allclose(poses, hands @ WRIST)
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    stats = json.loads((tmp_path / "set" / "meta" / "stats.json").read_text())
    for name in ("observation.images.ego", "observation.images.wrist"):
        assert info["features"][name]["dtype"] == "image"
        assert stats[name]["count"] == [len(made.frames)]
