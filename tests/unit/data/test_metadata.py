"""Metadata files: defaults of missing columns, and refusal of every invalid input."""

import dataclasses
import json
import os
import time

import pytest

from egosim_jax.data.metadata import check_presence, read_metadata, select
from egosim_jax.types import InputError

HEADER = "video,ego_prior_video,hand_keypoint_video,first_frame,prompt,video_id,split"
JSON = '{"ego_prior_video": "p.mp4", "video_id": "a", "prompt": %s}'
ROW = "a/video.mp4,a/prior.mp4,a/hands.mp4,a/first.png,pick it up,a,train"


@pytest.fixture
def write(tmp_path):
    def write(*lines, name="metadata.csv"):
        path = tmp_path / name
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return write


def test_paths_are_relative_to_the_metadata(write, tmp_path):
    (item,) = read_metadata(write(HEADER, ROW))
    assert item.prior == tmp_path / "a/prior.mp4"
    assert item.hands == tmp_path / "a/hands.mp4"
    assert item.first_frame == tmp_path / "a/first.png"
    assert item.target == tmp_path / "a/video.mp4"
    assert item.mask == tmp_path / "a/pc_mask_video.mp4"


@pytest.mark.parametrize("split", ["train", ""])
def test_further_columns_are_carried(write, split):
    (item,) = read_metadata(write(HEADER, ROW.removesuffix("train") + split))
    assert item.extra == {"split": split}


def test_a_file_without_the_column_video_has_no_truth(write):
    lines = [line.split(",", 1)[1] for line in (HEADER, ROW)]
    assert read_metadata(write(*lines))[0].target is None


def test_json_lines_say_the_same_as_csv(write):
    row = dict(zip(HEADER.split(","), ROW.split(","), strict=True))
    (from_json,) = read_metadata(write("", json.dumps(row), name="metadata.jsonl"))
    (from_csv,) = read_metadata(write(HEADER, ROW))
    assert from_json == dataclasses.replace(from_csv, row="metadata.jsonl line 2")


def test_a_prompt_may_hold_commas_and_line_breaks(write):
    items = read_metadata(
        write(HEADER, ROW.replace("pick it up", '"pick it up,\nput it down"'), _other("b"))
    )
    assert items[0].prompt == "pick it up,\nput it down"
    assert [item.row for item in items] == ["metadata.csv line 2", "metadata.csv line 4"]


@pytest.mark.parametrize(
    ("column", "cell"),
    [("video", ""), ("ego_prior_video", "  "), ("prompt", "nan"), ("video_id", "NaN")],
)
def test_an_empty_cell_is_named_by_line_and_column(write, column, cell):
    cells = ROW.split(",")
    cells[HEADER.split(",").index(column)] = cell
    with pytest.raises(InputError, match=f"line 3, column {column}: the cell is empty"):
        read_metadata(write(HEADER, _other("b"), ",".join(cells)))


@pytest.mark.parametrize(
    "video_id",
    ["../a", "a/../b", "/a", "a/", "a//b", "a.mp4/b", ".a", "a b", "a\\b", "é", "a" * 201],
)
def test_an_id_that_cannot_name_a_file_is_refused(write, video_id):
    with pytest.raises(InputError, match=r"line 2: video_id .* is not a valid file name"):
        read_metadata(write(HEADER, _other(video_id)))


def test_every_problem_is_listed_at_once(write):
    with pytest.raises(InputError) as caught:
        read_metadata(write(HEADER, _other("a b"), ROW.replace("pick it up", "")))
    assert "line 2" in str(caught.value)
    assert "line 3" in str(caught.value)


@pytest.mark.parametrize(
    ("lines", "name", "message"),
    [
        ([HEADER], "m.csv", "lists no clips"),
        ([HEADER, ROW, ROW], "m.csv", "line 3: video_id 'a' is a duplicate of line 2"),
        ([HEADER.replace("ego_prior_video,", "")], "m.csv", "no column ego_prior_video"),
        ([JSON % "null"], "m.jsonl", "line 1, column prompt"),
        ([JSON % '["a"]'], "m.jsonl", "not text or a number"),
        ([HEADER, ROW + ",more"], "m.csv", "line 2: 8 cells, but the header has 7"),
        ([HEADER + ",split", ROW + ",x"], "m.csv", "more than one column split"),
        ([HEADER, '"open'], "m.csv", "cannot be read as CSV"),
        (["{"], "m.jsonl", "line 1 is not valid JSON"),
        (["[]"], "m.jsonl", "line 1 is not a JSON object"),
        (["{}"], "m.jsonl", "line 1: no column ego_prior_video"),
    ],
)
def test_a_wrong_table_is_refused(write, lines, name, message):
    with pytest.raises(InputError, match=message):
        read_metadata(write(*lines, name=name))


@pytest.fixture
def items(write):
    lines = [_other(name, split) for name, split in (("a", "x"), ("b", "y"), ("c", "x"))]
    return read_metadata(write(HEADER, *lines))


@pytest.mark.parametrize(
    ("arguments", "chosen"),
    [
        ({"where": "split=x"}, "ac"),
        ({"video_ids": ["c", "a"]}, "ca"),
        ({"limit": 2}, "ab"),
    ],
)
def test_rows_are_selected(items, arguments, chosen):
    assert [item.video_id for item in select(items, **arguments)] == [*chosen]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"where": "splt=x"}, "with one of the columns split"),
        ({"where": "split"}, "must be COLUMN=VALUE"),
        ({"where": "split=z"}, "split is one of: x, y"),
        ({"video_ids": ["d"]}, "No clip has the id d"),
        ({"limit": 0}, "--limit must be at least 1, not 0"),
    ],
)
def test_a_selection_of_nothing_is_refused(items, arguments, message):
    with pytest.raises(InputError, match=message):
        select(items, **arguments)


def test_a_mistyped_id_gets_the_nearest_name(write):
    items = read_metadata(write(HEADER, _other("358/fold-1/cloth.7"), _other("pick_place_2")))
    with pytest.raises(InputError, match=r"Did you mean 358/fold-1/cloth\.7\?"):
        select(items, video_ids=["358/fold-1/cloth.8"])


def _other(video_id, split="train"):
    return f"v.mp4,p.mp4,h.mp4,f.png,pick it up,{video_id},{split}"


def test_the_minimal_columns_of_egosim_are_enough(write, tmp_path):
    (item,) = read_metadata(
        write("video,ego_prior_video,prompt", "part1/pour/7.mp4,renders/7/ego_prior.mp4,pour")
    )
    assert item.video_id == "part1_pour_7"
    assert item.hands == tmp_path / "renders/7/hand_kp_video.mp4"
    assert item.first_frame == tmp_path / "renders/7/hand_inpaint.png"
    assert item.mask == tmp_path / "renders/7/pc_mask_video.mp4"
    assert item.target == tmp_path / "part1/pour/7.mp4"
    assert item.extra == {}


def test_only_a_line_feed_ends_a_json_line(write):
    row = dict(zip(HEADER.split(","), ROW.split(","), strict=True)) | {"prompt": "a\u2028b\x85c"}
    line = json.dumps(row, ensure_ascii=False)
    (item,) = read_metadata(write(line, name="m.jsonl"))
    assert item.prompt == "a\u2028b\x85c"


@pytest.mark.parametrize("name", ["m.csv", "m.jsonl"])
@pytest.mark.parametrize(
    "data", [b"", b"\xff\xfe", b"\0" * 99, b"[" * 100_000, b'"' + b"a" * 200_000 + b'"\n']
)
def test_bytes_that_are_no_metadata_are_refused_in_short(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_metadata(tmp_path / name)
    assert len(str(caught.value)) < 1000


def test_a_pipe_is_refused_without_waiting_for_it(tmp_path):
    os.mkfifo(tmp_path / "m.csv")
    with pytest.raises(InputError, match="not a regular file"):
        read_metadata(tmp_path / "m.csv")


def test_a_hundred_thousand_missing_files_are_refused_at_once(write):
    items = read_metadata(write("video,ego_prior_video,prompt", "v.mp4,p.mp4,x"))
    many = [dataclasses.replace(items[0], video_id=str(n)) for n in range(1000)] * 100
    then = time.thread_time()
    with pytest.raises(InputError, match=r"None of the 100,000 clips has its prior video: .*, …"):
        check_presence(many)
    assert time.thread_time() - then < 5


def test_only_the_first_of_many_problems_are_listed(write):
    with pytest.raises(InputError, match="and 990 more") as caught:
        read_metadata(write(HEADER, *[_other(f"a b{n}") for n in range(1000)]))
    assert len(str(caught.value).split("; and ")) == 2
    assert str(caught.value).count("is not a valid file name") == 10
