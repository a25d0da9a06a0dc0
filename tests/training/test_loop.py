"""The loop around the update: skipped updates, EMA, gradient accumulation, logs and refusals."""

import dataclasses
import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.data.shards import ShardReader
from egosim_jax.io.run import open_folder
from egosim_jax.runtime.command import CommandExit, ExitCode
from egosim_jax.train.config import OptimizerConfig, numerics_only
from egosim_jax.train.loop import train
from egosim_jax.train.recipes import DEBUG
from egosim_jax.types import InputError, MeshConfig
from tests.training.killing import logged
from tests.training.line import POINTS, Line, training, write_points


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_points(tmp_path_factory.mktemp("points"))


def fit(out: Path, data: Path, *, validation: Path | None = None, **changes):
    return train(Line(), training(**changes), data=data, validation=validation, out=out)


def values(networks) -> np.ndarray:
    return np.concatenate([np.ravel(networks.kernel[...]), np.ravel(networks.bias[...])])


def test_the_loss_falls_and_the_time_spent_is_reported(points, tmp_path, capsys):
    fit(tmp_path, points, validation=points)
    log = logged(tmp_path)
    losses = [line["loss"] for line in log if "loss" in line]
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])
    checked = {line["step"]: line["validation_loss"] for line in log if "validation_loss" in line}
    assert list(checked) == [0, 20]
    assert checked[20] < checked[0]
    said = capsys.readouterr().err
    for phase in ("compiling", "waiting for data", "updates", "validation", "total"):
        assert phase in said
    assert json.loads((tmp_path / "times.json").read_text())["updates"] > 0


@pytest.mark.parametrize("size", [1, 16, 64])
def test_a_validation_has_all_records_whatever_the_batch(tmp_path, size):
    """Forty points; in float32, whose sums are taken in another order."""
    points = write_points(tmp_path / "points", unreadable=(POINTS - 1,))
    fit(tmp_path / "run", points, validation=points, batch_size=size, steps=1)
    begun = next(line["validation_loss"] for line in logged(tmp_path / "run"))
    networks = Line().networks(nnx.Rngs(0))
    errors = [
        np.square(networks(jnp.asarray(record["x"])) - record["y"]).mean()
        for record in (record.arrays for record in ShardReader(points))
        if np.isfinite(record["x"]).all()
    ]
    assert len(errors) == POINTS - 1
    assert begun == pytest.approx(np.mean(errors), rel=1e-6)


def test_a_validation_with_too_many_damaged_records_stops_the_run(points, tmp_path):
    bad = write_points(tmp_path / "points", unreadable=tuple(range(1, 18)))
    with pytest.raises(InputError, match=r"17 of 40 records .* cannot be read"):
        fit(tmp_path / "run", points, validation=bad)


def test_an_update_that_is_not_finite_is_skipped_and_named(tmp_path, capsys):
    data = write_points(tmp_path / "points", huge=(3,))
    fit(tmp_path / "run", data, steps=10)
    log = logged(tmp_path / "run")
    out = [line for line in log if line.get("skipped_updates")]
    assert len(out) == 2  # ten batches of eight see each of the forty points twice
    assert all("loss" not in line for line in out)
    assert all(np.isfinite(line["loss"]) for line in log if line not in out)
    said = capsys.readouterr().err
    assert f"step {out[0]['step']} skipped: loss inf" in said
    assert "point_3" in said


def test_a_skipped_update_changes_no_weight(tmp_path):
    data = write_points(tmp_path / "points", huge=(3,))
    fit(tmp_path / "long", data, steps=10)
    bad = next(line["step"] for line in logged(tmp_path / "long") if line.get("skipped_updates"))
    before = values(
        fit(tmp_path / "before", data, steps=bad - 1, optimizer={"schedule": "constant"})
    )
    after = values(fit(tmp_path / "after", data, steps=bad, optimizer={"schedule": "constant"}))
    np.testing.assert_array_equal(after, before)


def test_three_skips_in_a_row_stop_the_run_with_the_names(tmp_path, capsys):
    data = write_points(tmp_path / "points", huge=tuple(range(POINTS)))
    with pytest.raises(CommandExit, match="3 updates in a row") as stopped:
        fit(tmp_path / "run", data)
    assert stopped.value.code == ExitCode.FAILED
    said = capsys.readouterr().err
    assert [f"step {n} skipped" in said for n in (1, 2, 3, 4)] == [True, True, True, False]


@pytest.mark.parametrize(("factor", "skipped"), [(2.5, True), (None, False)])
def test_a_spike_of_the_gradient_norm_is_skipped_on_request(tmp_path, factor, skipped):
    data = write_points(tmp_path / "points", huge=(7,), factor=100.0)
    optimizer = {"skip_grad_norm_factor": factor}
    fit(tmp_path / "run", data, steps=70, log_every=1, save_every=70, optimizer=optimizer)
    late = [line for line in logged(tmp_path / "run") if line["step"] > 50]
    assert any("skipped_updates" in line for line in late) == skipped


def test_gradient_accumulation_gives_the_same_run(points, tmp_path):
    """Relative, in float32: sums are taken in another order."""
    whole = values(fit(tmp_path / "whole", points))
    parts = values(fit(tmp_path / "parts", points, grad_accum_steps=4))
    np.testing.assert_allclose(parts, whole, rtol=1e-5, atol=1e-6)


def test_the_ema_follows_its_formula(points, tmp_path):
    decay, steps = 0.6, 3
    weights = [
        values(fit(tmp_path / str(n), points, steps=n, save_every=n)).astype(float)
        for n in range(1, steps + 1)
    ]
    begin = values(Line().networks(nnx.Rngs(0))).astype(float)
    want = begin
    for step, now in enumerate(weights):
        warm = min(decay, (1 + step) / (10 + step))
        want = warm * want + (1 - warm) * now
    have = values(fit(tmp_path / "mean", points, steps=steps, optimizer={"ema_decay": decay}))
    np.testing.assert_allclose(have, want, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("decay", [0.9, 0.9999])
def test_the_average_is_warmed_up(decay):
    optimizer = OptimizerConfig(ema_decay=decay)
    first, later, last = (float(optimizer.ema_decay_at(jnp.int32(n))) for n in (0, 2, 10**6))
    assert (first, later) == pytest.approx((1 / 10, 3 / 12))
    assert last == pytest.approx(decay)


def test_a_run_resumes_with_other_intervals_but_not_with_another_seed(points, tmp_path):
    fit(tmp_path, points)
    fit(tmp_path, points, log_every=7, save_every=3, keep=5, hang_timeout_s=9.0)
    with pytest.raises(InputError, match=r"training\.seed"):
        fit(tmp_path, points, seed=1)


def test_a_training_resumes_though_its_model_samples_in_other_steps(tmp_path):
    task = DEBUG.stages()["denoiser"].task
    open_folder(tmp_path, {"task": task})
    fewer = dataclasses.replace(task, model=dataclasses.replace(task.model, steps=2))
    open_folder(tmp_path, {"task": fewer}, mutable=list(numerics_only(task, "task")))


def test_a_batch_that_devices_cannot_share_says_what_would_do(points, tmp_path):
    with pytest.raises(
        InputError, match=r"A batch of 8 .* 3 micro-batches.* multiple of their product, 3"
    ):
        fit(tmp_path, points, grad_accum_steps=3)
    with pytest.raises(InputError, match="does not fit 1 devices"):
        fit(tmp_path, points, mesh=MeshConfig(data=3))


def test_a_run_without_a_checkpoint_starts_again_with_other_options(points, tmp_path):
    with pytest.raises(InputError, match="cannot be shared"):
        fit(tmp_path, points, grad_accum_steps=3)
    fit(tmp_path, points, seed=1, steps=5)
    with pytest.raises(InputError, match=r"training\.seed"):
        fit(tmp_path, points, seed=2, steps=5)


def test_tensorboard_gets_the_numbers(points, tmp_path):
    fit(tmp_path, points, tensorboard=True)
    (events,) = (tmp_path / "tensorboard").iterdir()
    assert b"grad_norm" in events.read_bytes()


def test_wandb_resumes_its_run(points, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    fit(tmp_path, points, wandb="clips", keep=3)
    fit(tmp_path, points, wandb="clips")
    runs = list((tmp_path / "wandb").glob("offline-run-*/run-*.wandb"))
    assert len({run.stem for run in runs}) == 1
    logged = runs[0].read_bytes()
    assert b"grad_norm" in logged
    assert b"learning_rate" in logged  # the settings


def test_what_is_not_installed_is_named_with_its_extra(points, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(InputError, match=r"egosim-jax\[tensorboard\]"):
        fit(tmp_path, points, tensorboard=True)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("skip_grad_norm_factor", 1.0),
        ("ema_decay", 1.0),
        ("ema_decay", 0.0),
        ("clip_grad_norm", 0.0),
    ],
)
def test_optimizer_settings_out_of_range_are_refused(field, value):
    with pytest.raises(InputError, match=field):
        OptimizerConfig(**{field: value})
