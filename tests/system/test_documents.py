"""The Python of README and docs is run."""

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from egosim_jax.io.video import probe_video
from egosim_jax.state.snapshot import load

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"(?<=\n\n)(?: {4}(?:import|from) .*\n(?:(?: {4}.*)?\n)*)")


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NEED_WEIGHTS = {"networks.md"}
"""Pages whose Python runs networks that one has to download."""


def blocks(*, with_weights):
    """Return the indented blocks that begin with an import."""
    return [
        textwrap.dedent(block).strip()
        for page in PAGES
        if (page.name in NEED_WEIGHTS) == with_weights
        for block in BLOCK.findall(page.read_text("utf-8"))
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("readme")


@pytest.mark.parametrize(
    "code", blocks(with_weights=False), ids=lambda code: code.splitlines()[-1][:30]
)
def test_a_block_runs(code, folder):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, check=True)


@pytest.mark.parametrize("code", blocks(with_weights=True), ids=lambda code: code[:30])
def test_a_block_that_needs_weights_is_python_with_names_that_exist(code):
    compile(code, "block", "exec")
    exec("\n".join(line for line in code.splitlines() if "import" in line), {})  # noqa: S102


def test_the_loop_in_twenty_lines_writes_videos_and_a_state(folder):
    (code,) = (block for block in blocks(with_weights=False) if "simulator.step" in block)
    assert len([line for line in code.splitlines() if line.strip()]) <= 20
    for number in (1, 2, 3):
        assert probe_video(folder / "runs" / f"clip_{number}.mp4").frames == 17
    assert load(folder / "runs" / "state").step == 3
