"""The interface of RLinf's world-model environments, and its registration."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from egosim_jax.interactive.env.rewards import Reward
from egosim_jax.interactive.learn import rlinf
from egosim_jax.types import InputError
from tests.painted import VIDEO, painted

ROWS = 4


def far(outcome):
    """The first clip of an episode is worth 1, and the second solves it."""
    return Reward(reward=1.0, terminated=True, success=outcome.step.state.provenance["seed"] == "7")


@pytest.fixture
def make(monkeypatch):
    monkeypatch.setattr(rlinf, "load_backend", lambda *args, **options: painted())

    def env(number=2, **settings):
        config = {"reward": f"{__name__}:far", "max_episode_steps": 2 * ROWS, "seed": 0}
        monkeypatch.setitem(sys.modules, __name__, SimpleNamespace(far=far, __spec__=None))
        return rlinf.RLinfEnv(config | settings, number, 0, 1)

    return env


def rows(env, forward=0.1):
    present = np.stack([running.row for running in env.envs.running])
    return present[:, None] + np.linspace(0, forward, ROWS + 1)[1:, None] * np.eye(7)[1]


def test_a_chunk_returns_what_rlinf_reads(make):
    env = make(first_scene=10, scenes=1)
    assert env.chunk == ROWS
    seen, infos = env.reset()
    assert seen["main_images"].shape == (2, VIDEO.height, VIDEO.width, 3)
    assert seen["main_images"].dtype == torch.uint8
    assert seen["states"].shape == (2, 7)
    assert seen["task_descriptions"] == ["The right hand moves."] * 2
    assert infos == {}
    (seen,), reward, ended, truncated, (infos,) = env.chunk_step(torch.as_tensor(rows(env)))
    assert reward.tolist() == [[0, 0, 0, 1]] * 2
    assert not (ended | truncated).any()
    assert infos["episode"]["return"].tolist() == [1, 1]
    assert infos["episode"]["episode_len"].tolist() == [ROWS, ROWS]
    assert "final_observation" not in infos
    assert seen["states"][:, 1].tolist() == pytest.approx([0.12, 0.12], abs=1e-6)


def test_the_last_chunk_is_truncated_and_the_episode_begins_again(make):
    env = make(first_scene=10, scenes=1)
    first, _ = env.reset()
    env.chunk_step(rows(env))
    (seen,), _, ended, truncated, (infos,) = env.chunk_step(rows(env))
    assert truncated[:, -1].all()
    assert not truncated[:, :-1].any()
    assert not ended.any()
    assert torch.equal(seen["states"], first["states"])
    assert infos["final_observation"]["states"][:, 1] == pytest.approx([0.22, 0.22], abs=1e-6)
    assert infos["_final_observation"].all()
    assert infos["episode"]["return"].tolist() == [2, 2]
    assert env.elapsed_steps.tolist() == [0, 0]


def test_success_terminates_unless_terminations_are_ignored(make):
    for ignored in (False, True):
        env = make(first_scene=7, scenes=1, ignore_terminations=ignored, auto_reset=False)
        env.reset()
        *_, ended, _, (infos,) = env.chunk_step(rows(env))
        assert ended[:, -1].tolist() == [not ignored] * 2
        assert infos["episode"]["success_once"].all()
        env.chunk_step(rows(env))  # without auto_reset it continues


def test_a_group_shares_a_scene_and_rows_beyond_the_bounds_are_cut_off(make):
    env = make(4, group_size=2, first_scene=10, scenes=50)
    env.reset()
    scenes = [running.start.seed for running in env.envs.running]
    assert scenes[0] == scenes[1]
    assert scenes[2] == scenes[3]
    (seen,), *_ = env.chunk_step(rows(env, forward=9))
    assert seen["states"][:, 1].tolist() == pytest.approx([0.55] * 4)
    with pytest.raises(InputError, match="no multiple of 2"):
        make(3, group_size=2)
    with pytest.raises(NotImplementedError, match="chunk_step"):
        env.step(None)


def test_registered_environments_are_chosen_by_their_config(monkeypatch):
    """The requirements of RLinf exclude ours: modules stand for the two that have get_env_cls."""
    envs, worker = ModuleType("rlinf.envs"), ModuleType("rlinf.workers.env.env_worker")
    envs.get_env_cls = worker.get_env_cls = lambda env_type, env_cfg=None: dict
    package = ModuleType("rlinf.workers.env")
    package.env_worker = worker
    root = ModuleType("rlinf")
    root.envs = envs
    modules = {
        "rlinf": root,
        "rlinf.envs": envs,
        "rlinf.workers": ModuleType("rlinf.workers"),
        "rlinf.workers.env": package,
        "rlinf.workers.env.env_worker": worker,
    }
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    rlinf.register()
    for module in (envs, worker):
        assert module.get_env_cls("embodichain", {"simulator": "egosim_jax"}) is rlinf.RLinfEnv
        assert module.get_env_cls("libero", {}) is dict
