"""Script of docs/serving.md, in the true world with small frames."""

import re
from pathlib import Path

import pytest

import egosim_jax.interactive.env
from egosim_jax.interactive.env.true_world import TrueWorld
from egosim_jax.types import VideoSpec

ROOT = Path(__file__).parents[4]
VIDEO = VideoSpec(frames=17, height=8, width=16, fps=8)


@pytest.mark.slow
def test_the_documented_script_separates_good_policies_from_bad_ones(monkeypatch, capsys):
    text = (ROOT / "docs" / "serving.md").read_text("utf-8")
    script = re.findall(r"```python\n(.*?)```", text, re.S)[0]
    assert len(script.splitlines()) == 25
    monkeypatch.setattr(
        egosim_jax.interactive.env, "load_backend", lambda world, **options: TrueWorld(video=VIDEO)
    )
    for shown, small in (
        ('("generated", "true")', '("true",)'),
        ("[:8]", "[:2]"),
        ("num_envs=8", "num_envs=2"),
    ):
        assert shown in script
        script = script.replace(shown, small)
    exec(compile(script, "serving.md", "exec"), {})  # noqa: S102
    exact, never = capsys.readouterr().out.splitlines()
    assert exact == "true exact success 1.00"
    assert never == "true never closes success 0.00"
