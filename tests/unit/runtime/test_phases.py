"""Phases: a first line before the slow imports, lines in a log, a live line on a terminal."""

import io
import subprocess
import sys
import threading
import time

import pytest

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.generation.generator import Generator
from egosim_jax.runtime import phases
from egosim_jax.runtime.phases import phase, show_phases

WATCHED = """
import sys

class Watch:
    def find_spec(self, name, path=None, target=None):
        if name in ("jax", "numpy", "tyro"):
            print("imports", name, file=sys.stderr, flush=True)

sys.meta_path.insert(0, Watch())
from egosim_jax.cli.__main__ import main
main([*sys.argv[1:]])
"""


@pytest.mark.parametrize(
    "words",
    [
        ["simulate", "--episode", "missing"],
        ["serve", "--batch", "0"],
        ["train", "debug", "--training.steps", "0"],
    ],
    ids=lambda words: words[0],
)
def test_a_first_line_comes_before_the_slow_imports(words, tmp_path):
    command = [sys.executable, "-c", WATCHED, *words]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    lines = ran.stderr.splitlines()
    assert lines[0] == f"starts egosim {words[0]}"
    assert "imports numpy" in lines
    assert ran.stdout == ""
    loads = [number for number, line in enumerate(lines) if line.startswith("loads JAX")]
    if loads and "imports jax" in lines:
        assert loads[0] < lines.index("imports jax")


def test_a_log_has_a_line_per_phase_and_repeats_the_innermost(capsys, monkeypatch):
    monkeypatch.setattr(phases, "PLAIN_SECONDS", 0.05)
    with show_phases(), phase("loads"), phase("compiles 2 of 5: denoise"):
        time.sleep(0.4)
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == ""
    assert lines[:2] == ["loads", "compiles 2 of 5: denoise"]
    assert len(lines) > 2
    assert {*lines[2:]} == {"compiles 2 of 5: denoise: 0 s"}


def test_a_short_phase_can_be_silent(capsys, monkeypatch):
    with show_phases(), phase("renders", only_if_long=True):
        pass
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(phases, "PLAIN_SECONDS", 0.05)
    with show_phases(), phase("renders", only_if_long=True):
        time.sleep(0.4)
    assert "renders: 0 s" in capsys.readouterr().err


def test_a_terminal_has_a_live_line(monkeypatch, capsys):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    monkeypatch.setattr(phases, "LIVE_SECONDS", 0.05)
    with show_phases(), phase("compiles [a]"):
        time.sleep(1)
        print("a result")
    written = terminal.getvalue()
    assert written.startswith("compiles [a]\n")
    assert "compiles [a]: 0 s" in written
    assert capsys.readouterr().out == "a result\n"


def test_phases_end_with_their_work(capsys):
    with pytest.raises(ValueError, match="broken"), show_phases(), phase("loads"):
        raise ValueError("broken")
    assert not [thread for thread in threading.enumerate() if thread.name == "phase"]
    assert not phases._Shown.phases
    assert capsys.readouterr().err == "loads\n"


@pytest.mark.parametrize("name", ["debug", "tabletop_student"])
@pytest.mark.parametrize("streamed", [False, True])
def test_the_number_of_programs_is_known_before_they_are_traced(name, streamed):
    config = configs.get(name)
    generator = Generator(config, Networks.abstract(config))
    found = list(generator.programs(1, streamed=streamed))
    assert generator.count_programs(streamed=streamed) == len(found)
