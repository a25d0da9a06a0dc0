"""What surrounds the update: what is left out, averaged, taken in parts, written and refused."""

import dataclasses
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from flax import nnx

from egosim_jax.command import FAILED, CommandExit
from egosim_jax.sharding import MeshConfig
from egosim_jax.train.config import OptimizerConfig
from egosim_jax.train.loop import train
from egosim_jax.types import InputError
from tests.training.killing import logged
from tests.training.line import POINTS, Line, training, write_points


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_points(tmp_path_factory.mktemp("points"))


def fit(out: Path, data: Path, *, validation: Path | None = None, **changes):
    return train(Line(), training(**changes), data=data, validation=validation, out=out)


def values(networks) -> np.ndarray:
    return np.concatenate([np.ravel(networks.kernel[...]), np.ravel(networks.bias[...])])


def test_the_loss_falls_and_the_run_says_where_the_time_went(points, tmp_path, capsys):
    fit(tmp_path, points, validation=points)
    log = logged(tmp_path)
    losses = [line["loss"] for line in log if "loss" in line]
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])
    checked = {line["step"]: line["validation_loss"] for line in log if "validation_loss" in line}
    assert list(checked) == [0, 20]
    assert checked[20] < checked[0]
    said = capsys.readouterr().err
    for phase in ("compiling", "waiting for data", "updates", "validation", "in all"):
        assert phase in said


def test_an_update_that_is_not_finite_changes_nothing_and_is_named(tmp_path, capsys):
    data = write_points(tmp_path / "points", huge=(3,))
    fit(tmp_path / "run", data, steps=10)
    log = logged(tmp_path / "run")
    out = [line for line in log if line.get("left_out")]
    assert len(out) == 2  # ten batches of eight see each of the forty points twice
    assert all("loss" not in line for line in out)
    assert all(np.isfinite(line["loss"]) for line in log if line not in out)
    said = capsys.readouterr().err
    assert f"step {out[0]['step']} left out: loss inf" in said
    assert "point_3" in said


def test_weights_after_an_update_that_is_left_out_are_those_before(tmp_path):
    data = write_points(tmp_path / "points", huge=(3,))
    fit(tmp_path / "long", data, steps=10)
    bad = next(line["step"] for line in logged(tmp_path / "long") if line.get("left_out"))
    before = values(fit(tmp_path / "before", data, steps=bad - 1, optimizer={"decay": "constant"}))
    after = values(fit(tmp_path / "after", data, steps=bad, optimizer={"decay": "constant"}))
    np.testing.assert_array_equal(after, before)


def test_three_in_a_row_stop_the_run_with_the_names(tmp_path, capsys):
    data = write_points(tmp_path / "points", huge=tuple(range(POINTS)))
    with pytest.raises(CommandExit, match="3 updates in a row") as stopped:
        fit(tmp_path / "run", data)
    assert stopped.value.code == FAILED
    said = capsys.readouterr().err
    assert [f"step {n} left out" in said for n in (1, 2, 3, 4)] == [True, True, True, False]


@pytest.mark.parametrize(("spike", "left_out"), [(2.5, True), (None, False)])
def test_a_gradient_far_longer_than_usual_is_left_out_on_request(tmp_path, spike, left_out):
    data = write_points(tmp_path / "points", huge=(7,), factor=100.0)
    fit(tmp_path / "run", data, steps=70, log_every=1, save_every=70, optimizer={"spike": spike})
    late = [line for line in logged(tmp_path / "run") if line["step"] > 50]
    assert any("left_out" in line for line in late) == left_out


def test_a_batch_in_parts_gives_the_same_run(points, tmp_path):
    """Relative, in float32: sums are taken in another order."""
    whole = values(fit(tmp_path / "whole", points))
    parts = values(fit(tmp_path / "parts", points, accumulate=4))
    np.testing.assert_allclose(parts, whole, rtol=1e-5, atol=1e-6)


def test_the_average_is_what_its_formula_says(points, tmp_path):
    decay, steps = 0.8, 6
    weights = [
        values(fit(tmp_path / str(n), points, steps=n, save_every=n)).astype(float)
        for n in range(1, steps + 1)
    ]
    begin = values(Line().networks(nnx.Rngs(0))).astype(float)
    want = begin
    for now in weights:
        want = decay * want + (1 - decay) * now
    have = values(fit(tmp_path / "mean", points, steps=steps, optimizer={"average": decay}))
    np.testing.assert_allclose(have, want, rtol=1e-5, atol=1e-6)


def test_a_run_goes_on_with_other_habits_but_not_with_another_seed(points, tmp_path):
    fit(tmp_path, points)
    fit(tmp_path, points, log_every=7, save_every=3, keep=5, patience=9.0)
    with pytest.raises(InputError, match=r"training\.seed"):
        fit(tmp_path, points, seed=1)


def test_a_batch_that_devices_cannot_share_says_what_would_do(points, tmp_path):
    with pytest.raises(InputError, match=r"A batch of 8 .* 3 parts.* multiple of their product, 3"):
        fit(tmp_path, points, accumulate=3)


def test_a_mesh_that_is_not_of_the_devices_is_refused(points, tmp_path):
    with pytest.raises(InputError, match="does not fit 1 devices"):
        fit(tmp_path, points, mesh=MeshConfig(data=3))


def test_tensorboard_gets_the_numbers(points, tmp_path):
    fit(tmp_path, points, tensorboard=True)
    (events,) = (tmp_path / "tensorboard").iterdir()
    assert b"gradient_norm" in events.read_bytes()


def test_wandb_goes_on_in_the_run_it_began(points, tmp_path, monkeypatch):
    begun, logged = [], []

    def init(**settings):
        begun.append(settings)
        log = lambda values, step: logged.append(step)  # noqa: E731
        return SimpleNamespace(log=log, finish=lambda: logged.append("finished"))

    wandb = ModuleType("wandb")
    wandb.init, wandb.util = init, SimpleNamespace(generate_id=lambda: f"id{len(begun)}")
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    fit(tmp_path, points, wandb="clips", keep=3)
    assert logged == [*range(1, 21), "finished"]
    fit(tmp_path, points, wandb="clips")
    assert [settings["id"] for settings in begun] == ["id0", "id0"]
    assert begun[1]["resume"] == "allow"


def test_what_is_not_installed_is_named_with_its_extra(points, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(InputError, match=r"egosim-jax\[tensorboard\]"):
        fit(tmp_path, points, tensorboard=True)


@pytest.mark.parametrize(
    ("field", "value"), [("spike", 1.0), ("average", 1.0), ("average", 0.0), ("clip", 0.0)]
)
def test_optimizer_settings_that_mean_nothing_are_refused(field, value):
    with pytest.raises(InputError, match=field):
        OptimizerConfig(**{field: value})


def test_the_config_of_the_run_is_in_its_folder(points, tmp_path):
    fit(tmp_path, points)
    config = json.loads((tmp_path / "config.json").read_text("utf-8"))
    assert config["training"]["optimizer"]["learning_rate"] == 0.05
    assert config["training"]["batch_size"] == dataclasses.asdict(training())["batch_size"]
