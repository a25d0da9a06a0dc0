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
    ],
)
def test_the_reason_is_that_of_the_folder(tmp_path, file, message):
    (tmp_path / file).write_text("{}")
    with pytest.raises(InputError, match=message):
        View(path=tmp_path).run()


def test_a_page_that_exists_is_printed_and_not_written_elsewhere(tmp_path, capsys):
    for name in ("report.json", "index.html"):
        (tmp_path / name).write_text("{}")
    View(path=tmp_path).run()
    assert capsys.readouterr().out.strip() == str(tmp_path / "index.html")
    with pytest.raises(InputError, match="would not be written"):
        View(path=tmp_path, out=tmp_path / "other.html").run()


@pytest.mark.parametrize("file", ["journal.jsonl", "simulation.rrd"])
def test_without_rerun_the_extra_is_named(tmp_path, monkeypatch, file):
    monkeypatch.setattr("egosim_jax.cli.view.find_spec", lambda name: None)
    (tmp_path / file).touch()
    with pytest.raises(InputError, match=r"pip install 'egosim-jax\[viewer\]'"):
        View(path=tmp_path).run()


def test_with_rerun_the_extra_is_not_named(tmp_path, monkeypatch):
    monkeypatch.setattr("egosim_jax.cli.view.find_spec", lambda name: name)
    (tmp_path / "journal.jsonl").touch()
    with pytest.raises(InputError, match="run the same command again") as refused:
        View(path=tmp_path).run()
    assert "pip install" not in str(refused.value)


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
