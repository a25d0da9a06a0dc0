"""Scripts of docs/policy_training.md, in a painted world and for fewer clips."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml

import egosim_jax.interactive.env
from egosim_jax.interactive.env.true_world import TrueWorld
from egosim_jax.interactive.learn import rlinf
from egosim_jax.types import VideoSpec
from tests.painted import painted

ROOT = Path(__file__).parents[4]
VIDEO = VideoSpec(frames=17, height=8, width=16, fps=8)
TEXT = (ROOT / "docs" / "policy_training.md").read_text("utf-8")
SB3, TORCHRL, OWN, JUDGE = re.findall(r"```python\n(.*?)```", TEXT, re.S)
(CONFIG,) = re.findall(r"```yaml\n(.*?)```", TEXT, re.S)


@pytest.fixture(autouse=True)
def small_worlds(monkeypatch):
    def load(world, **options):
        return TrueWorld(video=VIDEO) if world == "true" else painted()

    monkeypatch.setattr(egosim_jax.interactive.env, "load_backend", load)
    monkeypatch.setattr(rlinf, "load_backend", load)


def run(script):
    names = {}
    exec(compile(script, "policy_training.md", "exec"), names)  # noqa: S102
    return names


def smaller(script, *numbers):
    for shown, small in (("num_envs=8", "num_envs=2"), *numbers):
        assert shown in script
        script = script.replace(shown, small)
    return script


def test_ppo_of_stable_baselines3_runs():
    torch.manual_seed(0)
    numbers = ("n_steps=4, batch_size=32", "n_steps=1, batch_size=2"), ("learn(320)", "learn(2)")
    assert run(smaller(SB3, *numbers))["model"].num_timesteps == 2


def test_a_rollout_of_torchrl_runs(capsys):
    run(smaller(TORCHRL, ("rollout(4", "rollout(1")))
    assert 0 <= float(capsys.readouterr().out) <= 1


def test_the_own_skill_moves_the_hand(capsys):
    run(OWN)
    rows = re.findall(r"\[([\d. -]+)\]", capsys.readouterr().out)
    assert [[float(n) for n in row.split()] for row in rows] == [
        pytest.approx([0.25, 0.12, 0.26], abs=1e-6)
    ] * 2


def test_the_judge_and_the_config_are_understood(monkeypatch):
    judge = SimpleNamespace(**run(JUDGE), __spec__=None)
    monkeypatch.setitem(sys.modules, "my_judge", judge)
    monkeypatch.setitem(sys.modules, "my_model", SimpleNamespace(score=lambda frames, text: 0.75))
    config = yaml.safe_load(CONFIG)
    assert config.keys() >= {"env_type", "simulator", "reward"}
    env = rlinf.RLinfEnv(config | {"reward": "my_judge:lifted"}, 4, 0, 1)
    env.reset()
    rows = torch.as_tensor(np.stack([running.row for running in env.envs.running]))[:, None]
    _, reward, ended, _, _ = env.chunk_step(rows)
    assert reward.tolist() == [[0.75]] * 4
    assert ended.all()
