"""`egosim doctor`: the folders of weights that it reports."""

from pathlib import Path

from egosim_jax.cli import doctor
from egosim_jax.cli.doctor import Doctor
from egosim_jax.configs import releases
from egosim_jax.io import hub


def test_a_package_that_is_installed_under_another_name_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor, "LIBRARIES", ("jax", "opencv-by-another-name"))
    monkeypatch.setattr(doctor, "_print_models", lambda *_: None)
    assert Doctor().run() == 0
    assert "opencv-by-another-name not installed" in " ".join(capsys.readouterr().out.split())


def test_fetched_weights_are_listed_and_files_are_not(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(hub, "fetched_folder", lambda name: tmp_path / "cache" / name)
    (tmp_path / "weights" / "mine").mkdir(parents=True)
    (tmp_path / "weights" / "notes.txt").write_text("not weights")
    fetched = tmp_path / "cache" / next(iter(releases()))
    fetched.mkdir(parents=True)
    assert Doctor()._folders()[-1] == Path("weights/mine")
    (fetched / hub.RECORD).write_text("{}")
    assert Doctor()._folders()[-2:] == [Path("weights/mine"), fetched]


def test_the_last_line_says_whether_this_machine_is_ready(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert Doctor().run() == 0
    last = " ".join(capsys.readouterr().out.split("\n")[-2:])
    assert last.startswith("Ready: ")
    assert "weights of tabletop, tabletop_student" in last
    monkeypatch.setattr(doctor, "NATIVE", ("cv2", "no_such_module"))
    assert Doctor().run() == 1
    assert capsys.readouterr().out.splitlines()[-1] == "Not ready: repair the modules above."
