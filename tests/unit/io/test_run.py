"""Run folders: the config and environment that they record, and the runs that they refuse."""

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest

from egosim_jax.io import run
from egosim_jax.io.run import open_folder, write_json
from egosim_jax.runtime.options import show_options
from egosim_jax.types import InputError, VideoSpec


@dataclass(frozen=True)
class Config:
    seed: int
    video: VideoSpec


def config(seed: int = 0) -> Config:
    return Config(seed=seed, video=VideoSpec(frames=5, height=32, width=48))


def test_a_new_folder_records_config_and_environment(tmp_path):
    open_folder(tmp_path / "run", config())
    recorded = json.loads((tmp_path / "run/config.json").read_text("utf-8"))
    assert recorded["video"] == {"type": "VideoSpec", "frames": 5, "height": 32, "width": 48,
                                 "fps": 16}  # fmt: skip
    environment = json.loads((tmp_path / "run/environment.json").read_text("utf-8"))
    assert environment["packages"]["jax"]


def test_the_commit_is_of_this_packages_checkout_alone(tmp_path, monkeypatch):
    def git(*arguments: str) -> str:
        user = ("-c", "user.name=a", "-c", "user.email=a@example.com")
        command = ["git", "-C", str(tmp_path), *user, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init")
    git("commit", "--allow-empty", "--message", "Begin")
    monkeypatch.setattr(run, "__file__", str(tmp_path / "egosim_jax/io/run.py"))
    assert run._commit() == git("rev-parse", "HEAD")
    installed = tmp_path / ".venv/lib/egosim_jax/io"
    installed.mkdir(parents=True)
    monkeypatch.setattr(run, "__file__", str(installed / "run.py"))
    assert run._commit() is None


def test_a_moved_folder_is_continued_with_the_same_config(tmp_path):
    job = {"simulate": {"out": tmp_path / "here", "seed": 0}}
    open_folder(tmp_path / "here", job)
    (tmp_path / "here").rename(tmp_path / "there")
    job["simulate"]["out"] = tmp_path / "there"
    open_folder(tmp_path / "there", job)
    job["simulate"]["seed"] = 1
    with pytest.raises(InputError, match=r"simulate\.seed: the folder has 0, this run has 1"):
        open_folder(tmp_path / "there", job)
    (tmp_path / "there" / "config.json").unlink()
    with pytest.raises(InputError, match=r"config\.json is missing.*another --out"):
        open_folder(tmp_path / "there", job)


@dataclass(frozen=True)
class Mesh:
    data: int = 1


@dataclass(frozen=True)
class Command:
    """A parsed command; the scene is a positional argument."""

    scene: Annotated[str, "tyro.conf.Positional"] = ""
    min_hands: float = 0.5
    focal: float | None = None
    steps: int = 4
    mesh: Mesh = Mesh()


def test_options_are_named_as_they_are_typed_before_digests(tmp_path):
    def made_of(hands: float, steps: int, digest: str) -> dict:
        return {
            "weights": {"dit": 8 * digest},
            "cutting": {"quality": {"min_hands": hands}},
            "focal_px": hands,
            "simulate": {"steps": steps, "scene": digest},
            "model": {"steps": steps, "layers": steps},
            "training": {"mesh": {"data": steps}},
        }

    open_folder(tmp_path, made_of(0.5, 4, "abcdef01"))
    with show_options(Command()), pytest.raises(InputError) as refused:
        open_folder(tmp_path, made_of(0.25, 9, "12345678"))
    said = str(refused.value)
    assert "Choose another --out" in said
    shown = said.partition("same config: ")[2].removesuffix(".").split("; ")
    assert {line.split(":")[0] for line in shown[:4]} == {
        "--min-hands", "--focal", "--steps", "--mesh.data"
    }  # fmt: skip
    assert "--min-hands: the folder has 0.5, this run has 0.25" in shown
    assert shown[4].startswith("model.layers: ")
    assert shown[5] == "and 2 more"
    assert "abcdef01abc" not in said


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="--out"):
        open_folder(tmp_path / "file" / "run", config())


def test_a_value_that_cannot_be_written_leaves_the_old_file(tmp_path: Path):
    path = tmp_path / "value.json"
    write_json(path, {"a": 1})
    circular: list = []
    circular.append(circular)
    with pytest.raises(RecursionError):
        write_json(path, circular)
    assert json.loads(path.read_text("utf-8")) == {"a": 1}


def test_a_mutable_field_may_change_and_is_recorded(tmp_path):
    open_folder(tmp_path, {"training": {"mesh": {"fsdp": 8}, "meshes": 1, "seed": 0}})
    changed = {"training": {"mesh": {"fsdp": 4}, "meshes": 1, "seed": 0}}
    open_folder(tmp_path, changed, mutable=["training.mesh"])
    assert json.loads((tmp_path / "config.json").read_text("utf-8")) == changed
    other = {"training": {"mesh": {"fsdp": 2}, "meshes": 2, "seed": 0}}
    with pytest.raises(InputError, match=r"training\.meshes") as refused:
        open_folder(tmp_path, other, mutable=["training.mesh"])
    assert "mesh.fsdp" not in str(refused.value)


def test_a_run_that_has_not_begun_takes_another_config(tmp_path):
    open_folder(tmp_path, {"seed": 0})
    open_folder(tmp_path, {"seed": 1}, begun=False)
    with pytest.raises(InputError, match="seed"):
        open_folder(tmp_path, {"seed": 2})


@pytest.mark.parametrize(
    ("recorded", "wanted", "message"),
    [
        (["cup", "dish"], ["cup", "bowl"], r"names\.1: the folder has 'dish', this run has 'bowl'"),
        ([1, 2], [1], r"names: the folder has \[1, 2\], this run has \[1\]"),
        ([], ["cup"], r'names: the folder has \[\], this run has \["cup"\]'),
        ([{"seed": 1}], [{"seed": 2}], r"names\.0\.seed: the folder has 1, this run has 2"),
        ({"a": 1}, [1], r'names: the folder has {"a": 1}, this run has \[1\]'),
        (
            [*range(90)],
            [*range(91)],
            r"has ….*, 88, 89\], .* has ….*, 88, 89, 90\]",
        ),
        ("a" * 99 + "b", "a" * 99 + "c", r"names: the folder has …a+b', this run has …a+c'"),
        (8 * "abcdef01", 8 * "12345678", "has 'abcdef01…', this run has '12345678…'"),
    ],
    ids=["item", "shorter", "empty", "nested", "kinds", "longer", "end of a text", "digest"],
)
def test_different_values_are_shown_by_their_difference(tmp_path, recorded, wanted, message):
    open_folder(tmp_path, {"names": recorded})
    with pytest.raises(InputError, match=message):
        open_folder(tmp_path, {"names": wanted})


@pytest.mark.parametrize("text", ["", "{", "[]", '{"a": 1, "a": 2}', "\x00", '"' + "x" * 100])
def test_a_damaged_config_is_named(tmp_path, text):
    open_folder(tmp_path, config())
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(InputError, match=r"config\.json"):
        open_folder(tmp_path, config())
