"""Refusals of `egosim view`, by the folder."""

import pytest

from egosim_jax.cli.view import View
from egosim_jax.types import InputError


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("report.json", "cannot be viewed: give the folder of a simulation"),  # of an experiment
        ("journal.jsonl", "no simulation.rrd, which egosim simulate writes where Rerun is"),
        ("state.json", "not a readable state"),
        ("times.json", r"is a training: metrics.jsonl has its curves.*--training\.tensorboard"),
    ],
)
def test_the_reason_is_that_of_the_folder(tmp_path, file, message):
    (tmp_path / file).write_text("{}")
    with pytest.raises(InputError, match=message):
        View(path=tmp_path).run()


@pytest.mark.parametrize("file", ["journal.jsonl", "simulation.rrd"])
def test_without_rerun_the_extra_is_named(tmp_path, monkeypatch, file):
    monkeypatch.setattr("egosim_jax.cli.view.find_spec", lambda name: None)
    (tmp_path / file).touch()
    with pytest.raises(InputError, match="viewer"):
        View(path=tmp_path).run()


def test_a_simulation_without_states_has_none_to_look_at(tmp_path, monkeypatch):
    monkeypatch.setattr("egosim_jax.cli.view.find_spec", lambda name: name)
    (tmp_path / "journal.jsonl").touch()
    for named in (False, True):
        with pytest.raises(InputError) as refused:
            View(path=tmp_path).run()
        assert ("state_0.ply" in str(refused.value)) == named
        (tmp_path / "state_0.ply").touch()


@pytest.mark.parametrize("name", ["x.txt", "x.ply", "x"])
def test_a_drawing_is_an_image(tmp_path, name):
    with pytest.raises(InputError, match=r"is no image: its name must end in \.png"):
        View(path=tmp_path / "cloud.ply", out=tmp_path / name).run()
