"""The examples run as they are: scripts and notebooks, in a new folder."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from egosim_jax.io.video import probe_video

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted(
    path for path in (ROOT / "examples").iterdir() if path.suffix in {".py", ".ipynb"}
)


def code(path):
    """Return the Python of a script, or of a notebook's code cells."""
    if path.suffix == ".py":
        return path.read_text("utf-8")
    cells = json.loads(path.read_text("utf-8"))["cells"]
    return "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "code")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("examples")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(path, folder):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    subprocess.run([sys.executable, "-c", code(path)], cwd=folder, env=environment, check=True)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_a_notebook_has_no_outputs(path):
    if path.suffix == ".py":
        assert len(path.read_text("utf-8").splitlines()) <= 40
    else:
        cells = json.loads(path.read_text("utf-8"))["cells"]
        assert not any(c.get("outputs") or c.get("execution_count") for c in cells)


def test_the_examples_write_their_videos(folder):
    videos = [folder / "runs/examples/edit_state/before_after.mp4"]
    videos += [folder / f"runs/examples/generate_clip/seed_{n}.mp4" for n in range(3)]
    assert [probe_video(path).frames for path in videos] == [17] * 4
