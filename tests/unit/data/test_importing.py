"""Imports resume, keep what other sources wrote, and name what they skip."""

import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import ClassVar

import pytest

from egosim_jax.cli.__main__ import main
from egosim_jax.data.importing import import_recordings
from egosim_jax.data.readers import Entry, inside, make_id, natural_order
from egosim_jax.data.recording import Recording
from egosim_jax.types import InputError
from tests.captures import World


@dataclass(frozen=True, kw_only=True)
class Listed:
    """A reader of synthetic recordings; recordings named bad fail."""

    dataset: ClassVar[str] = "listed"
    names: tuple[str, ...]
    read: list
    source: Path = Path("/data")
    option: str = "1"

    def find(self):
        for name in self.names:
            yield Entry(
                recording_id=name,
                read=lambda folder, name=name: self.make(name),
                source=self.source / name,
                options={"--option": self.option},
            )

    def make(self, name):
        self.read.append(name)
        if name.startswith("bad"):
            raise InputError(f"{name} is damaged.")
        return Recording(
            recording_id="x", video=Path("/v.mp4"), frames=5, fps=Fraction(30), height=8, width=8
        )


def run(reader, out, **options):
    return list(import_recordings(reader, out, **options)[1])


def test_bad_entries_are_named_and_an_interrupted_import_resumes(tmp_path):
    read = []
    outcomes = run(Listed(names=("a", "bad", "b"), read=read), tmp_path)
    assert [o.problem for o in outcomes] == [None, "bad is damaged.", None]
    shutil.rmtree(tmp_path / "b")
    outcomes = run(Listed(names=("a", "bad", "b"), read=read), tmp_path)
    assert [o.resumed for o in outcomes] == [True, False, False]
    assert read == ["a", "bad", "b", "bad", "b"]
    assert sorted(path.parent.name for path in tmp_path.glob("*/recording.json")) == ["a", "b"]
    provenance = Recording.load(tmp_path / "a").provenance
    assert provenance == {"dataset": "listed", "source": "/data/a", "--option": "1"}


def test_a_damaged_recording_is_made_again(tmp_path):
    read = []
    run(Listed(names=("a",), read=read), tmp_path)
    (tmp_path / "a/arrays.npz").write_bytes(b"")
    run(Listed(names=("a",), read=read), tmp_path)
    assert read == ["a", "a"]
    Recording.load(tmp_path / "a")


@pytest.mark.parametrize("change", [{"option": "2"}, {"source": Path("/other")}])
def test_recordings_of_another_source_or_options_are_kept(tmp_path, change):
    run(Listed(names=("a",), read=[]), tmp_path)
    (outcome,) = run(Listed(names=("a",), read=[], **change), tmp_path)
    assert "--out" in outcome.problem


def test_ids_that_collide_are_named(tmp_path):
    outcomes = run(Listed(names=("a", "a"), read=[]), tmp_path)
    assert "ids must be unique" in outcomes[1].problem


@pytest.mark.parametrize("error", [InputError("refused"), KeyboardInterrupt()])
def test_a_refused_or_interrupted_recording_leaves_nothing(tmp_path, error):
    class Failing(Listed):
        def find(self):
            def read(folder):
                World(frames=4).write_video(folder / "video.mp4")
                raise error

            yield Entry(recording_id="a", read=read, source=self.source)

    with suppress(KeyboardInterrupt):
        assert run(Failing(names=(), read=[]), tmp_path)[0].problem == "refused"
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


@pytest.mark.parametrize("member", ["the source", "its folder", "a link", "the video"])
def test_a_name_that_is_not_utf8_is_skipped_and_the_others_are_imported(tmp_path, member):
    name, place = os.fsdecode(b"caf\xe9"), tmp_path / "set"
    odd = {"its folder": place / name / "b", "the source": place / name}.get(member, place / "b")

    class Odd(Listed):
        def find(self):
            yield from super().find()
            video = Path(f"/{name}.mp4" if member == "the video" else "/v.mp4")
            made = Recording(
                recording_id="b", video=video, frames=5, fps=Fraction(30), height=8, width=8
            )
            yield Entry(recording_id="b", read=lambda folder: made, source=odd)

    if member == "a link":
        (tmp_path / name).mkdir()
        place.mkdir()
        odd.symlink_to(tmp_path / name)
    good, bad = run(Odd(names=("a",), read=[]), tmp_path / "out")
    assert good.problem is None
    assert "caf\\udce9" in bad.problem
    assert [path.name for path in (tmp_path / "out").iterdir() if path.is_dir()] == ["a"]


def test_a_folder_with_other_files_is_not_replaced(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a/video.mp4").write_bytes(b"mine")
    (outcome,) = run(Listed(names=("a",), read=[]), tmp_path)
    assert "Choose another path" in outcome.problem
    assert (tmp_path / "a/video.mp4").read_bytes() == b"mine"


def test_a_limit_reads_only_the_first_entries(tmp_path):
    read = []
    assert len(run(Listed(names=("a", "b"), read=read), tmp_path, limit=1)) == 1
    assert read == ["a"]


def test_ids_are_valid_names_and_numbers_sort_by_value():
    assert make_id(["part 1", "../x", "a.b"]) == "part_1_.._x_a.b"
    assert make_id([".hidden"]) == "hidden"
    names = [Path(name) for name in ("a10", "a9", "a1/b", "b")]
    assert sorted(names, key=natural_order) == [Path(n) for n in ("a1/b", "a9", "a10", "b")]


@pytest.mark.parametrize("name", ["../x", "/x", "a/../../x", "", None, 3, "a\0b"])
def test_paths_outside_the_dataset_are_refused(tmp_path, name):
    with pytest.raises(InputError, match="inside the dataset"):
        inside(tmp_path, name, what="a path")


def test_the_command_reports_what_it_skips_and_resumes(tmp_path, capsys):
    world = World(frames=4)
    world.write_video(tmp_path / "set/a.mp4")
    (tmp_path / "set/list.csv").write_text("video,caption\na.mp4,Wait\nb.mp4,Wait\n")
    args = ["data", "import", "taste_rob", str(tmp_path / "set"), "--out", str(tmp_path / "out")]
    assert main(args) == 3
    printed = capsys.readouterr()
    assert printed.out.strip() == str(tmp_path / "out")
    assert "skipped: b: " in printed.err
    assert "1 of 2 recordings imported" in printed.err
    assert main([*args, "--limit", "1"]) == 0
    assert "1 of them earlier" in capsys.readouterr().err
