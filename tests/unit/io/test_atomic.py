"""Written files are complete or absent."""

import fcntl
import json
import os
import subprocess
import sys

import pytest

from egosim_jax.io.atomic import append_line, atomic_folder, atomic_write, lock_folder


def test_a_file_has_its_name_when_all_is_written(tmp_path):
    path = tmp_path / "new" / "image.png"
    with atomic_write(path) as temporary:
        assert temporary.suffix == ".png"
        temporary.write_text("half", encoding="utf-8")
        assert not path.exists()
        temporary.write_text("whole", encoding="utf-8")
    assert path.read_text("utf-8") == "whole"
    assert list(path.parent.iterdir()) == [path]


def test_after_an_error_the_older_file_stays_and_nothing_else(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("older", encoding="utf-8")
    with pytest.raises(UnicodeEncodeError), atomic_write(path) as temporary:
        temporary.write_text("half \ud800", encoding="utf-8")
    assert path.read_text("utf-8") == "older"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_in_the_way_of_a_temporary_name_is_not_followed(tmp_path, monkeypatch):
    monkeypatch.setattr("secrets.token_hex", lambda size: "0" * 16)
    victim = tmp_path / "victim"
    victim.write_text("mine", encoding="utf-8")
    (tmp_path / ".file.0000000000000000.tmp.txt").symlink_to(victim)
    with pytest.raises(FileExistsError), atomic_write(tmp_path / "file.txt"):
        pass
    assert victim.read_text("utf-8") == "mine"


def test_names_are_unpredictable_and_a_link_at_the_path_is_replaced(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("mine", encoding="utf-8")
    (tmp_path / "file.txt").symlink_to(victim)
    names = set()
    for _ in range(2):
        with atomic_write(tmp_path / "file.txt") as temporary:
            names.add(temporary.name)
            temporary.write_text("new", encoding="utf-8")
    assert len(names) == 2
    assert victim.read_text("utf-8") == "mine"
    assert not (tmp_path / "file.txt").is_symlink()


def test_what_a_killed_writer_left_is_removed_and_what_a_live_one_writes_is_not(tmp_path):
    left = tmp_path / ".file.00112233445566aa.tmp.txt"
    live = tmp_path / ".file.00112233445566bb.tmp.txt"
    other = tmp_path / ".other.00112233445566aa.tmp.txt"
    for path in (left, live, other):
        path.write_text("half", encoding="utf-8")
    with live.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with atomic_write(tmp_path / "file.txt") as temporary:
            temporary.write_text("all", encoding="utf-8")
    assert {path.name for path in tmp_path.iterdir()} == {live.name, other.name, "file.txt"}


def test_a_folder_is_exchanged_in_one_step(tmp_path):
    path = tmp_path / "state"
    for text in ("older", "newer"):
        with atomic_folder(path) as temporary:
            (temporary / "inner").mkdir()
            (temporary / "inner" / "file").write_text(text, encoding="utf-8")
        assert (path / "inner" / "file").read_text("utf-8") == text
    with pytest.raises(FileExistsError), atomic_folder(path) as temporary:
        os.mkdir(temporary)
    assert (path / "inner" / "file").read_text("utf-8") == "newer"
    assert list(tmp_path.iterdir()) == [path]


def test_lines_are_appended_after_the_last_complete_one(tmp_path):
    path = tmp_path / "lines.jsonl"
    append_line(path, {"a": 1})
    with path.open("a") as file:
        file.write('{"a": 2')
    append_line(path, {"a": 3})
    assert [json.loads(line) for line in path.read_text("utf-8").splitlines()] == [
        {"a": 1},
        {"a": 3},
    ]


def test_a_second_process_is_refused_and_the_first_one_named(tmp_path):
    program = (
        "import sys, pathlib; from egosim_jax.io.atomic import lock_folder\n"
        "from egosim_jax.types import InputError\n"
        "try:\n    lock_folder(pathlib.Path(sys.argv[1])).__enter__(); print('locked')\n"
        "except InputError as error: print(error)"
    )

    def other() -> str:
        command = [sys.executable, "-c", program, str(tmp_path)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    with lock_folder(tmp_path), lock_folder(tmp_path):
        assert f"in use by another process (PID {os.getpid()})" in other()
    assert other() == "locked\n"
