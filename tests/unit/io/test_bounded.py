"""Untrusted bytes are bounded before anything is built from them, and never shown in full."""

import json
import os

import pytest

from egosim_jax.io.bounded import (
    MAX_QUOTED,
    check_version,
    open_regular,
    parse_json,
    quote,
    quote_text,
    read_bytes,
    read_json,
    read_lines,
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
