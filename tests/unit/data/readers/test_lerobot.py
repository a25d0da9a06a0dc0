"""LeRobot v2.1 and v3.0: episodes are the right frames, with their tasks."""

import json

import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from egosim_jax.data.readers.lerobot import LeRobot, read_tasks
from egosim_jax.types import InputError

KEY = "observation.images.head"


def write_info(root, version, **changes):
    video = {"dtype": "video", "shape": [96, 128, 3], "names": ["height", "width", "channel"]}
    info = {
        "codebase_version": version,
        "fps": 30,
        "chunks_size": 1000,
        "features": {
            KEY: video,
            "observation.images.wrist": video,
            "observation.state": {"dtype": "float32", "shape": [7]},
        },
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    }
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta/info.json").write_text(json.dumps(info | changes))


def write_v3(root, world, *, tasks=True, **changes):
    """Two episodes in one AV1 file, of 7 and 5 frames."""
    write_info(root, "v3.0", **changes)
    world.write_video(root / f"videos/{KEY}/chunk-000/file-000.mp4", codec="libsvtav1")
    rows = {
        "episode_index": [0, 1],
        "length": [7, 5],
        "tasks": [["pick the cup"], ["place the cup", "wait"]],
        "data/chunk_index": [0, 0],
        "data/file_index": [0, 0],
        "dataset_from_index": [0, 7],
        f"videos/{KEY}/chunk_index": [0, 0],
        f"videos/{KEY}/file_index": [0, 0],
        f"videos/{KEY}/from_timestamp": [0.0, 7 / 30],
        f"videos/{KEY}/to_timestamp": [7 / 30, 12 / 30],
        "stats/action/mean": [[0.0], [0.0]],
    }
    if not tasks:
        del rows["tasks"]
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True)
    pq.write_table(pa.table(rows), path)
    frames = {"episode_index": [0] * 7 + [1] * 5, "task_index": [1] * 7 + [0] * 5}
    (root / "data/chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(frames), root / "data/chunk-000/file-000.parquet")
    index = pandas.Index(["place the cup", "pick the cup"], name="task")
    pandas.DataFrame({"task_index": [0, 1]}, index=index).to_parquet(root / "meta/tasks.parquet")


def write_v2(root, world):
    write_info(
        root,
        "v2.1",
        video_path="videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    )
    for number in range(2):
        world.write_video(root / f"videos/chunk-000/{KEY}/episode_{number:06d}.mp4")
    tasks = [["task 0"], "task 1", ["task 2"]]
    lines = [{"episode_index": n, "tasks": tasks[n], "length": world.frames} for n in range(3)]
    text = "\n".join(json.dumps(line) for line in lines)
    (root / "meta/episodes.jsonl").write_text(text)


def test_v3_tasks_are_read_from_frames_where_episodes_do_not_name_them(world, tmp_path, imported):
    write_v3(tmp_path / "set", world, tasks=False)
    done, _ = imported(LeRobot(source=tmp_path / "set"))
    assert [r.caption for r in done.values()] == ["pick the cup", "place the cup"]


def test_an_episode_without_a_table_has_no_task(world, tmp_path, imported):
    write_v3(tmp_path / "set", world, tasks=False, data_path="")
    done, problems = imported(LeRobot(source=tmp_path / "set"))
    assert [recording.caption for recording in done.values()] == [None, None]
    assert not problems


def test_without_the_table_of_tasks_the_rest_is_read(world, tmp_path, imported, caplog):
    write_v3(tmp_path / "set", world, tasks=False)
    (tmp_path / "set/meta/tasks.parquet").unlink()
    done, problems = imported(LeRobot(source=tmp_path / "set"))
    assert not problems
    assert {recording.caption for recording in done.values()} == {None}
    assert "its tasks stay unknown" in caplog.text


def test_both_forms_of_tasks_are_read(tmp_path):
    (tmp_path / "meta").mkdir()
    path = tmp_path / "meta/tasks.parquet"
    pandas.DataFrame({"task_index": [0, 1]}, index=["a", "b"]).to_parquet(path)
    assert read_tasks(tmp_path) == {0: "a", 1: "b"}
    pandas.DataFrame({"task_index": [0, 1], "task": ["a", "b"]}).to_parquet(path)
    assert read_tasks(tmp_path) == {0: "a", 1: "b"}


def test_v2_has_one_video_per_episode_and_reports_a_missing_one(world, tmp_path, imported):
    write_v2(tmp_path / "set", world)
    done, problems = imported(LeRobot(source=tmp_path / "set"))
    assert [r.caption for r in done.values()] == ["task 0", "task 1"]
    world.assert_first(done["episode_000001"])
    assert "episode_000002.mp4 cannot be read" in problems["episode_000002"]


def test_an_episode_beyond_the_end_of_its_video_is_refused(world, tmp_path, imported):
    write_v3(tmp_path / "set", world)
    path = tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path).to_pydict()
    table[f"videos/{KEY}/from_timestamp"][1] = 14 / 30
    table[f"videos/{KEY}/to_timestamp"][1] = 19 / 30
    pq.write_table(pa.table(table), path)
    done, problems = imported(LeRobot(source=tmp_path / "set"))
    assert list(done) == ["episode_000000"]
    assert "which has 12" in problems["episode_000001"]


def test_the_camera_must_be_clear(world, tmp_path):
    video = {"dtype": "video", "shape": [96, 128, 3]}
    write_v3(tmp_path / "set", world, features={"images.left": video, "images.right": video})
    with pytest.raises(InputError, match=r"images\.left; images\.right"):
        list(LeRobot(source=tmp_path / "set").find())
    with pytest.raises(InputError, match="--camera"):
        list(LeRobot(source=tmp_path / "set", camera="head").find())


@pytest.mark.parametrize(
    "template",
    [
        "../{video_key}/{chunk_index}.mp4",
        "/etc/{video_key}.mp4",
        "{video_key.__class__}.mp4",
        "{video_key!r}.mp4",
        "{chunk_index:999999999d}.mp4",
        "{other}.mp4",
        "{",
    ],
)
def test_a_template_that_escapes_is_refused(world, tmp_path, imported, template):
    write_v3(tmp_path / "set", world, video_path=template)
    done, problems = imported(LeRobot(source=tmp_path / "set"))
    assert not done
    assert all("video_path" in problem for problem in problems.values())


def test_damaged_and_incomplete_tables_are_refused(world, tmp_path):
    write_v3(tmp_path / "set", world)
    path = tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    data = path.read_bytes()
    path.write_bytes(data[:-9])
    with pytest.raises(InputError, match="not a readable Parquet"):
        list(LeRobot(source=tmp_path / "set").find())
    pq.write_table(pa.table({"episode_index": [0]}), path)
    with pytest.raises(InputError, match="no column"):
        list(LeRobot(source=tmp_path / "set").find())


def test_another_version_is_refused(world, tmp_path):
    write_info(tmp_path, "v1.6")
    with pytest.raises(InputError, match=r"v1\.6"):
        list(LeRobot(source=tmp_path).find())
