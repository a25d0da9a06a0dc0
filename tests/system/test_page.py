"""The pages of a table and of a training in a real browser; chromium is installed by .ci/run."""

import csv
import subprocess

import numpy as np
import pytest
from PIL import Image

from egosim_jax import testing
from egosim_jax.cli.table import TableCommand
from egosim_jax.io.video import read_video, write_video
from egosim_jax.train.run_page import write_page
from tests.training.finished import write_stage

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Page of a table of one method and a baseline, with a hostile prompt."""
    root = tmp_path_factory.mktemp("page")
    metadata = testing.write_dataset(root)
    with metadata.open(newline="") as file:
        rows = list(csv.DictReader(file))
    prompt = "<script>document.body.innerHTML=''</script><b>bold</b>"
    with metadata.open("w", newline="") as file:
        table = csv.DictWriter(file, [*rows[0], "dataset"])
        table.writeheader()
        table.writerows({**row, "prompt": prompt, "dataset": "egodex"} for row in rows)
    for number in range(2):
        video = read_video(root / f"clip{number}" / "video.mp4").frames
        red = np.zeros_like(video)
        red[..., 0] = 220
        write_video(root / "red" / f"clip{number}.mp4", red, 16)
    TableCommand(
        name="egosim",
        generated=(str(root / "red"),),
        baselines=("still",),
        metadata=metadata,
        out=root / "out",
    ).run()
    return root / "out" / "index.html"


def browse(page, *options):
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += [f"--user-data-dir={page.parent / 'profile'}", "--window-size=1400,1900"]
    command += ["--virtual-time-budget=3000", *options, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


def test_the_browser_shows_the_tables_and_no_markup_of_a_prompt(page):
    dom = browse(page, "--dump-dom")
    assert "EgoSim (published)" in dom
    assert "25.06" in dom
    assert "&lt;b&gt;bold&lt;/b&gt;" in dom
    assert "<script" not in dom
    assert dom.count("<video") == 2


def test_the_browser_plays_the_clips(page):
    shot = page.parent / "page.png"
    browse(page, f"--screenshot={shot}")
    pixels = np.asarray(Image.open(shot).convert("RGB")).astype(int)
    red = (pixels[..., 0] > 180) & (pixels[..., 1:].max(axis=-1) < 40)
    # The red clip is the left third of each of the two videos, 456 of 1368 pixels from 16 on.
    columns = np.flatnonzero(red.sum(axis=0) > 300)
    assert len(columns) == pytest.approx(456, abs=12)
    assert columns.max() < 490


def test_the_page_is_one_file_that_loads_nothing(page):
    text = page.read_text()
    assert "default-src 'none'" in text
    assert "http://" not in text
    assert "https://" not in text
    assert len(text) < 300_000


def test_the_browser_draws_the_curves_and_samples_of_a_training(tmp_path):
    page = write_page(write_stage(tmp_path / "run", samples=(40,)))
    shot = tmp_path / "page.png"
    browse(page, f"--screenshot={shot}")
    pixels = np.asarray(Image.open(shot).convert("RGB")).astype(int)
    for color in ((31, 119, 180), (255, 127, 14)):  # of training and of validation
        near = np.abs(pixels - color).max(axis=-1) < 12
        assert near.sum() > 100
        assert np.flatnonzero(near.any(axis=1)).max() < 420  # in the plots, which are at the top
    red = (pixels[..., 0] > 180) & (pixels[..., 1:].max(axis=-1) < 40)
    assert red.sum() > 3 * 64 * 96 * 0.95  # the video, and two frames on the sheet
