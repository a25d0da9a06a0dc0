"""Run folders of before options, metrics and state got their names of today."""

import dataclasses
import json
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from egosim_jax.io.checkpoint import Checkpoints
from egosim_jax.io.renamed import upgrade
from egosim_jax.io.run import open_folder
from egosim_jax.train.config import numerics_only, resume_mutable
from egosim_jax.train.loop import train
from egosim_jax.train.recipes import DEBUG
from egosim_jax.types import InputError
from tests.training.killing import logged
from tests.training.line import Line, training, write_points

OLD_RUN = json.loads((Path(__file__).parents[1] / "golden" / "old_run.json").read_text("utf-8"))
"""The three config.json of `egosim-train debug --out runs/debug` at commit b291cad."""
OLD_NAMES = {
    "TrainConfig": "Training",
    "grad_accum_steps": "accumulate",
    "hang_timeout_s": "patience",
    "name": "rule",
    "warmup_steps": "warmup",
    "schedule": "decay",
    "clip_grad_norm": "clip",
    "skip_grad_norm_factor": "spike",
    "ema_decay": "average",
    "lr": "rate",
    "grad_norm": "gradient_norm",
    "step_time_s": "seconds",
    "data_wait_frac": "waiting",
    "peak_mem_gb": "gigabytes",
    "eta_min": "minutes_left",
    "skipped_updates": "left_out",
}


OLD_STATE = ("step", "params", "moments", "usual_norm", "left_out", "average")
OldState = jax.tree_util.register_dataclass(dataclasses.make_dataclass("OldState", OLD_STATE))


def with_old_names(text: str) -> str:
    for name, old in OLD_NAMES.items():
        text = text.replace(f'"{name}"', f'"{old}"')
    return text


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_points(tmp_path_factory.mktemp("points"), huge=(3,))


def fit(out: Path, points: Path) -> np.ndarray:
    config = training(keep=4, optimizer={"ema_decay": 0.9})
    networks = train(Line(), config, data=points, validation=None, out=out)
    return np.ravel(networks.kernel[...])


def test_an_old_run_resumes_bit_for_bit(points, tmp_path, monkeypatch):
    whole = fit(tmp_path / "whole", points)
    save = Checkpoints.save

    def save_old(self, step, state, data):
        values = (getattr(state, field.name) for field in dataclasses.fields(state))
        save(self, step, OldState(*values), data)

    with monkeypatch.context() as old:
        old.setattr(Checkpoints, "save", save_old)
        fit(tmp_path / "old", points)
    out = tmp_path / "old"
    shutil.rmtree(out / "checkpoints" / "20")
    for name in ("config.json", "metrics.jsonl"):
        path = out / name
        path.write_text(with_old_names(path.read_text("utf-8")))
    assert '"rate"' in (out / "metrics.jsonl").read_text("utf-8")
    np.testing.assert_array_equal(fit(out, points), whole)
    assert logged(out) == logged(tmp_path / "whole")
    assert '"TrainConfig"' in (out / "config.json").read_text("utf-8")


def test_the_configs_of_an_old_run_are_those_of_today(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(OLD_RUN["run"]))
    mutable = [*resume_mutable("vae", "denoiser"), "preflight", "json", "search"]
    open_folder(tmp_path, DEBUG, mutable=mutable)
    for name, (task, config) in DEBUG.stages().items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / "config.json").write_text(json.dumps(OLD_RUN[name]))
        record = {"task": task, "training": config, "weights": None}
        open_folder(folder, record, mutable=resume_mutable("training"))


def test_a_training_resumes_though_its_model_samples_in_other_steps(tmp_path):
    task = DEBUG.stages()["denoiser"].task
    open_folder(tmp_path, {"task": task})
    fewer = replace(task, model=replace(task.model, steps=2))
    open_folder(tmp_path, {"task": fewer}, mutable=list(numerics_only(task, "task")))


def test_a_difference_from_an_old_run_is_named_as_today(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(OLD_RUN["run"]))
    changed = replace(DEBUG.vae, optimizer=replace(DEBUG.vae.optimizer, warmup_steps=7))
    with pytest.raises(InputError, match=r"vae\.optimizer\.warmup_steps: the folder has 5"):
        open_folder(tmp_path, replace(DEBUG, vae=changed))


def test_configs_of_today_are_not_changed():
    today = upgrade(OLD_RUN["denoiser"])
    assert upgrade(today) == today


def test_an_experiment_with_the_name_of_an_old_recipe_keeps_it():
    experiment = {"experiment": {"type": "Tabletop", "clips": 6}}
    assert upgrade(experiment) == experiment
