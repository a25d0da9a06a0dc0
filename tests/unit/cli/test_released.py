"""The commands of docs/released.md, on tiny random weights in the released layout."""

import re
import shlex
from pathlib import Path

import pytest

from egosim_jax.cli.__main__ import main
from egosim_jax.io.bounded import read_json
from egosim_jax.runtime.command import ExitCode
from tests.unit.cli.test_models import published, served  # noqa: F401 - fixtures

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "released.md").read_text("utf-8")
FETCH, GENERATE, TABLE = re.findall(r"^    egosim (.*)$", PAGE, re.M)[:3]


@pytest.fixture
def clips(make_clips):
    """Metadata of two clips of the size of `debug`, with the column of the paper's sets."""
    path = make_clips(2, height=64, width=96)
    header, *lines = path.read_text().splitlines()
    lines = [f"{line},egodex" for line in lines]
    path.write_text("\n".join([f"{header},dataset", *lines]) + "\n")
    return path


def run(command, clips):
    """Run a command of the page with the config `debug` and the paths of this test."""
    args = [arg.replace("egosim_14b", "debug") for arg in shlex.split(command)]
    args = [arg.replace("clips/metadata.csv", str(clips)) for arg in args]
    return main(args)


@pytest.mark.slow
@pytest.mark.usefixtures("served")
def test_fetch_generate_and_compare(clips, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(FETCH, clips) == ExitCode.DONE
    assert run(f"{GENERATE} --steps 2", clips) == ExitCode.DONE
    assert run(GENERATE.replace("runs/released", "outputs/egosim") + " --steps 2", clips) == 0
    assert run(f"{TABLE} --page-clips 0", clips) == ExitCode.DONE
    report = read_json(Path("runs/released_table/report.json"))
    text = str(report)
    assert "ours" in text
    assert "published" in text
