"""Script of docs/environments.md, in the true world with small frames."""

import re
from pathlib import Path

import pytest

import egosim_jax.interactive.env
from egosim_jax.interactive.env.true_world import TrueWorld
from egosim_jax.types import VideoSpec

ROOT = Path(__file__).parents[4]
VIDEO = VideoSpec(frames=17, height=8, width=16, fps=8)
TEXT = (ROOT / "docs" / "environments.md").read_text("utf-8")
LIFT, CAMERAS = re.findall(r"```python\n(.*?)```", TEXT, re.S)


@pytest.fixture(autouse=True)
def small_frames(monkeypatch):
    monkeypatch.setattr(
        egosim_jax.interactive.env, "load_backend", lambda world, **options: TrueWorld(video=VIDEO)
    )


def run(script):
    exec(compile(script, "environments.md", "exec"), {})  # noqa: S102


def test_the_documented_policy_lifts_the_object_whose_pose_it_reads(capsys):
    run(LIFT)
    assert capsys.readouterr().out == "red box rises by 0.1 m\n"


def test_the_documented_cameras_show_the_true_world(capsys):
    run(CAMERAS)
    shape = (VIDEO.frames, VIDEO.height, VIDEO.width, 3)
    assert capsys.readouterr().out.startswith(f"{shape} {{'wrist': 0.")
