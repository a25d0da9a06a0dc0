"""Untrusted bytes are bounded before anything is built from them, and never shown in full."""

import io
import json
import os
import tracemalloc
from pathlib import Path

import pytest

from egosim_jax.io.bounded import (
    MAX_QUOTED,
    check_version,
    named,
    only_inside,
    open_regular,
    parse_json,
    plot_text,
    quote,
    quote_text,
    read_bytes,
    read_json,
    read_lines,
    unlike,
)
from egosim_jax.types import InputError


def test_only_regular_files_are_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, tmp_path / "missing", tmp_path / "nul\0"):
        with pytest.raises(InputError):
            open_regular(path)
    with pytest.raises(InputError, match="not a regular file"):
        open_regular(tmp_path / "pipe")


def test_a_file_above_the_limit_is_refused(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_bytes(path, limit=5) == b"12345"
    with pytest.raises(InputError, match="more than 4 bytes"):
        read_bytes(path, limit=4)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[" * 200_000, "too deeply"),
        ('{"a": 1, "a": 2}', "'a' is repeated"),
        ('{"a": "\\ud800"}', "surrogate"),
        ("{", "not valid JSON"),
        ("9" * 10_000, "not valid JSON"),
        ('"\xff"', "not valid JSON"),
    ],
    ids=["deep", "repeated", "surrogate", "cut off", "number", "not UTF-8"],
)
def test_json_that_is_refused(text, why):
    with pytest.raises(InputError, match=why) as error:
        parse_json(text.encode("latin-1"), source="x.json")
    assert "x.json" in str(error.value)
    assert len(str(error.value)) < 300


def test_json_that_is_read(tmp_path):
    value = {"a": [1, 2.5, None, "é\u2028", "\U0001f600"]}
    path = tmp_path / "x.json"
    path.write_text(json.dumps(value), encoding="utf-8")
    assert read_json(path) == value
    path.write_text(json.dumps(value, ensure_ascii=False), encoding="utf-8")
    assert read_json(path) == value


@pytest.mark.parametrize(
    "unit",
    ["[],", "{},", "[[]],", '{"a":0},', '"a",', "0.5,", '"\U0001f600",', "1234,"],
    ids=["lists", "maps", "nested", "small maps", "texts", "numbers", "wide texts", "integers"],
)
def test_json_that_would_fill_the_memory_is_refused_before_it_is_parsed(unit):
    size = 64 << 20
    data = f"[{unit * (size // len(unit.encode()))}0]".encode()
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"x\.json: its .* bytes of memory.*Split it"):
            parse_json(data, source="x.json", limit=2 * size)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("unit", ["[],", '{"a":0},', '"ab",', "0.5,", '"\\u1234",'])
def test_json_takes_no_more_memory_than_was_estimated(unit, monkeypatch):
    data = f"[{unit * 50_000}0]".encode()
    tracemalloc.start()
    try:
        value = parse_json(data, source="x.json")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(value) == 50_001
    monkeypatch.setattr("egosim_jax.io.bounded.MAX_MEMORY", peak)
    with pytest.raises(InputError, match="Split it"):
        parse_json(data, source="x.json")


def test_links_out_of_the_source_are_refused_and_those_of_a_hub_cache_followed(tmp_path):
    (tmp_path / "secret").write_text("mine")
    source = tmp_path / "repo" / "snapshots" / "1f"
    blobs = tmp_path / "repo" / "blobs"
    for folder in (source, blobs):
        folder.mkdir(parents=True)
    (blobs / "5e").write_text("blob")
    (source / "own").write_text("own")
    targets = {"blob": blobs / "5e", "out": tmp_path / "secret", "in": "own", "loop": "loop"}
    for name, target in targets.items():
        (source / name).symlink_to(target)
    with only_inside([source]):
        for name, text in (("own", b"own"), ("in", b"own"), ("blob", b"blob")):
            assert read_bytes(source / name, limit=9) == text
        with pytest.raises(InputError, match="is a link to a file outside"):
            read_bytes(source / "out", limit=9)
        with pytest.raises(InputError, match="cannot be read"):
            read_bytes(source / "loop", limit=9)
    assert read_bytes(source / "out", limit=9) == b"mine"


@pytest.mark.parametrize("name", ["self/mem", "self/status", "version"])
def test_files_of_the_kernel_are_not_opened(name):
    with pytest.raises(InputError, match="give a file on a disk"):
        read_bytes(Path("/proc") / name, limit=100)


@pytest.mark.parametrize(
    "text", [r"$\foo$", "$x", r"\$a$b$", "a\nb", "\x1b[31m", "$" * 1000], ids=ascii
)
def test_titles_of_plots_are_no_formulas(text):
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().set_title(plot_text(text))
    figure.savefig(io.BytesIO(), format="png")


def test_a_line_ends_with_a_line_feed_only_and_a_torn_one_is_dropped(tmp_path):
    path = tmp_path / "x.jsonl"
    path.write_bytes('{"a": "1\u2028\x85"}\n\n{"a": 2}\n{"a"'.encode())
    assert list(read_lines(path)) == [(1, {"a": "1\u2028\x85"}), (3, {"a": 2})]


@pytest.mark.parametrize(
    "value",
    ["x" * 10**6, b"x" * 10**6, 1 << 10**6, [[]] * 10**6, {"x" * 10**6: 1}, "\x1b[31m"],
    ids=["text", "bytes", "number", "list", "dict", "escape"],
)
def test_what_is_quoted_is_short_and_printable(value):
    text = quote(value)
    assert len(text) < MAX_QUOTED + 20
    assert text.isprintable()


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a clip", "a clip"),
        ("it's", "it's"),
        ("it's " + "x" * 90, "it's " + "x" * 75 + "…"),
        ("ends'", "ends'"),
        ("a\nb", r"a\nb"),
    ],
)
def test_text_is_shown_without_quotation_marks(text, shown):
    assert quote_text(text) == shown


@pytest.mark.parametrize("version", [0, 2, 1.0, True, "1", None, [1]])
def test_another_version_of_a_format_is_refused_with_the_fix(version):
    with pytest.raises(InputError, match=r"^state\.json has version .* reads version 1\. Make it"):
        check_version(version, 1, source="state.json")
    check_version(1, 1, source="state.json")


@pytest.mark.parametrize(
    ("name", "text", "shown"),
    [
        ("a.ply", "a.ply cannot be read: it is empty.", "a.ply cannot be read: it is empty."),
        ("a.ply", "no colors.", "a.ply: no colors."),
        ("shard-0 record 3", "shard-0 record 3 is damaged", "shard-0 record 3 is damaged"),
        ("b", "a.ply cannot be read", "b: a.ply cannot be read"),
    ],
)
def test_a_file_is_named_once(name, text, shown):
    assert named(name, InputError(text)) == shown


@pytest.mark.parametrize(
    ("value", "limit", "shown"),
    [
        (49.7, 50.0, "49.7"),
        (49.97, 50.0, "49.97"),
        (115.00004, 115.0, "115.00004"),
        (79.6, 80.0, "79.6"),
        (12.3456, 50.0, "12.3"),
        (0.0, 1.0, "0"),
        (float("nan"), 1.0, "nan"),
        (50.0, 50.0, "50.0"),
    ],
)
def test_a_number_is_never_shown_as_the_limit_that_it_breaks(value, limit, shown):
    assert unlike(value, limit) == shown
