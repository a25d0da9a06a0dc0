"""`egosim evaluate-policy`: the documented policy, and refused options."""

import json
import re
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

import egosim_jax.interactive.env
from egosim_jax.cli.evaluate_policy import EvaluatePolicy
from egosim_jax.geometry import look_at
from egosim_jax.interactive.env.true_world import TrueWorld
from egosim_jax.runtime.command import CommandExit, ExitCode
from egosim_jax.types import InputError, VideoSpec

ROOT = Path(__file__).parents[3]
VIDEO = VideoSpec(frames=17, height=8, width=16, fps=8)
PAGE = (ROOT / "docs" / "policies.md").read_text("utf-8")
(POLICY,) = re.findall(r"(?<=\n\n)((?: {4}.*\n|\n)+)(?=It lifts)", PAGE)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """The true world with small frames."""
    world = TrueWorld(video=VIDEO)
    monkeypatch.setattr(egosim_jax.interactive.env, "load_backend", lambda *_, **__: world)
    return world


@pytest.fixture
def module(tmp_path, monkeypatch):
    """The documented policy, as a module that Python can import."""
    (tmp_path / "lift.py").write_text(textwrap.dedent(POLICY))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("lift", None)


def command(out, **changes):
    options = {"policies": ("lift:lift",), "tasks": ("red box lifted by 8 cm",), "out": out}
    return EvaluatePolicy(**{**options, "starts": ("tabletop:0",), "world": "true", **changes})


def test_the_documented_policy_lifts_an_object_and_all_files_are_written(module, tmp_path, capsys):
    out = tmp_path / "out"
    assert command(out).run() == ExitCode.DONE
    printed = capsys.readouterr().out.splitlines()
    report = json.loads((out / "report.json").read_text())
    (trial,) = report["trials"]
    assert (trial["success"], trial["clips"], trial["ended"]) == (True, 2, "success")
    written = [out / "report.json", out / "index.html", out / "lerobot" / "lift-lift"]
    assert printed[-3:] == [str(path) for path in written]
    assert (out / "trials" / trial["id"] / "video.mp4").exists()
    before = (out / "trials" / trial["id"] / "trial.json").stat().st_mtime_ns
    assert command(out).run() == ExitCode.DONE
    assert (out / "trials" / trial["id"] / "trial.json").stat().st_mtime_ns == before
    with pytest.raises(InputError, match="run of another config"):
        command(out, seed=1).run()


def test_a_policy_sees_further_cameras_and_its_dataset_has_them(module, tmp_path, monkeypatch):
    import lift

    seen = []

    def looks(observation):
        seen.append((observation["side.image"], observation["side.frames"], observation["image"]))
        return observation["row"] if observation["chunk"] == 0 else None

    monkeypatch.setattr(lift, "looks", looks, raising=False)
    pose = look_at(np.array([0.45, 0.05, 0.42]), np.array([0, 0.28, 0.03]), up=np.eye(3)[2])
    (tmp_path / "cameras.json").write_text(
        json.dumps([{"name": "side", "mount": "world", "pose": pose.tolist()}])
    )
    options = {"cameras": tmp_path / "cameras.json", "policies": ("lift:looks",)}
    assert command(tmp_path / "out", **options).run() == ExitCode.DONE
    image, frames, main = seen[1]
    assert frames.shape == (VIDEO.frames, VIDEO.height, VIDEO.width, 3)
    assert (image == frames[-1]).all()
    assert (image != main).any()
    info = json.loads((tmp_path / "out" / "lerobot" / "lift-looks" / "meta/info.json").read_text())
    assert "observation.images.side" in info["features"]


def test_a_policy_that_fails_is_listed(module, tmp_path, monkeypatch, capsys):
    import lift

    monkeypatch.setattr(lift, "lift", lambda observation: 1 / 0)
    with pytest.raises(CommandExit) as ended:
        command(tmp_path / "out").run()
    assert ended.value.code == ExitCode.FAILED
    assert "failed: lift:lift, red box lifted by 8 cm, tabletop:0" in capsys.readouterr().err


def test_other_policies_count_although_one_fails(module, tmp_path, monkeypatch):
    import lift

    monkeypatch.setattr(lift, "fails", lambda observation: 1 / 0, raising=False)
    monkeypatch.setattr(lift, "rests", lambda observation: None, raising=False)
    both = command(tmp_path / "out", policies=("lift:rests", "lift:fails"), dataset=False)
    assert both.run() == ExitCode.PARTIAL
    assert list(json.loads((tmp_path / "out" / "report.json").read_text())["failed"])


@pytest.mark.parametrize(
    ("changes", "option"),
    [
        ({"policies": ("nothing",)}, "--policies"),
        ({"tasks": ("red box flies",)}, "--tasks"),
        ({"starts": ("nowhere",)}, "--starts"),
        ({"send": ("nothing",)}, "--send"),
        ({"clips_per_trial": 0}, "--clips-per-trial"),
        ({"batch": 0}, "--batch"),
        ({"seed": -1}, "--seed"),
        ({"page_clips": -1}, "--page-clips"),
        ({"wait": -1.0}, "--wait"),
        ({"send": ("wrist=wrist.image",)}, "--send"),
        ({"cameras": ROOT / "pyproject.toml"}, "JSON"),
        ({"cameras": ROOT / "tests" / "system" / "shipped.json"}, "--cameras"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(module, tmp_path, changes, option):
    with pytest.raises(InputError, match=option):
        command(tmp_path / "out", **changes).run()
    assert not (tmp_path / "out").exists()
