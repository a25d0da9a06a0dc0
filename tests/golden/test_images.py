"""Golden images: the ray caster, the point and hand renderers and the contact sheet draw as before.

    python -m tests.golden.test_images

draws them again, after a change that is meant to change them.
"""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egosim_jax.data.sheet import TITLE_PX, SheetClip, draw_sheet
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_triplet

IMAGES = Path(__file__).parent / "images"
SPEC = VideoSpec(frames=5, height=48, width=80)
SEEDS = {"human": 3, "robot": 7}
LEVELS = 2
"""Maximum difference of a pixel, of 255: a rounding of the mean of its rays."""
EDGES = 0.005
"""Maximum share of other pixels: at edges, other vector units may round a ray hit otherwise."""


def draw(kind, path: Path) -> None:
    """Draw ground truth, prior and hands of a clip, its first and its last frame."""
    triplet = to_triplet(next(make_sequence(SEEDS[kind], spec=SPEC, kind=kind)))
    assert triplet.target is not None
    draw_sheet(
        [SheetClip("", [triplet.target, triplet.prior, triplet.hands])], path, moments=(0, 4)
    )


@pytest.mark.parametrize("kind", SEEDS)
def test_a_contact_sheet_of_the_tabletop_world_looks_as_before(kind, tmp_path):
    draw(kind, tmp_path / "sheet.png")
    drawn = np.asarray(Image.open(tmp_path / "sheet.png")).astype(int)
    golden = np.asarray(Image.open(IMAGES / f"sheet_{kind}.png"))
    assert drawn.shape == golden.shape
    assert (drawn[:TITLE_PX] == 255).all()
    other = (np.abs(drawn - golden) > LEVELS).any(axis=-1)
    assert other.mean() <= EDGES


def test_the_title_of_a_contact_sheet_is_above_its_frames(tmp_path):
    frames = np.full((3, 16, 96, 3), 255, np.uint8)
    draw_sheet([SheetClip("title", [frames])], tmp_path / "sheet.png", moments=(0,))
    drawn = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert (drawn[:TITLE_PX] < 128).any()
    assert (drawn[TITLE_PX:] == 255).all()


if __name__ == "__main__":
    for kind in SEEDS:
        draw(kind, IMAGES / f"sheet_{kind}.png")
