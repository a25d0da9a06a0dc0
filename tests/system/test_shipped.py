"""The shipped weights reach their recorded scores.

Retraining changes every figure: `python -m tests.system.test_shipped` writes `shipped.json` and
`shipped.png` again, the only places that have them.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egosim_jax import configs
from egosim_jax.cli.__main__ import main
from egosim_jax.configs.model import Networks
from egosim_jax.evaluation.metrics.report import score
from egosim_jax.generation.generator import Generator
from egosim_jax.io.digest import sha256
from egosim_jax.worlds.tabletop import make_sequence, to_triplet
from egosim_jax.worlds.tabletop.dataset import conditions_of

EXPECTED, IMAGE = (Path(__file__).with_name(f"shipped.{end}") for end in ("json", "png"))
NAME, SEED = "tabletop", 0
FRAMES = (0, 3, 6, 9, 12, 16)
"""Frames of the image."""
LEVELS, OTHERS = 2, 1e-3
"""A pixel may differ by so many levels of 255; the share that may differ more."""
MARGIN_DB = 0.1
"""A score may be below the expected one by so much: machines sum in other orders."""


def digests() -> dict[str, str]:
    return {f.name: sha256(f) for f in sorted((configs.SHIPPED / NAME).glob("*.safetensors"))}


def make_clip() -> tuple[np.ndarray, float]:
    """Generate a clip of a held-out scene; return its frames and PSNR in dB."""
    config, folder = configs.get(NAME), configs.weights_of(NAME, None)
    target = next(make_sequence(SEED, spec=config.video))
    triplet = to_triplet(target, prior=conditions_of(config)[0])
    generator = Generator(config.at(folder), Networks.load(config, folder))
    (clip,) = generator.generate([triplet], seeds=[SEED])
    return clip.frames, score(clip.frames[1:], target.frames[1:])["psnr"]


def side_by_side(frames: np.ndarray) -> np.ndarray:
    return np.concatenate([frames[number] for number in FRAMES], axis=1)


def simulate(out: Path) -> list[float]:
    """Run the closed loop for two clips; return the PSNR of each in dB."""
    assert main(["simulate", "--clips", "2", "--seed", str(SEED), "--out", str(out)]) == 0
    report = json.loads((out / "report.json").read_text("utf-8"))
    return [clip["psnr"] for clip in report["clips"]]


@pytest.fixture(scope="module")
def expected():
    return json.loads(EXPECTED.read_text("utf-8"))


@pytest.fixture(scope="module")
def clip():
    return make_clip()


def test_the_files_are_those_that_were_released(expected):
    assert digests() == expected["sha256"]


def test_a_clip_is_as_close_to_the_target_as_before(clip, expected):
    assert clip[1] >= expected["clip_psnr_db"] - MARGIN_DB


def test_a_clip_has_the_golden_frames(clip):
    golden = np.asarray(Image.open(IMAGE)).astype(int)
    error = np.abs(side_by_side(clip[0]) - golden).max(axis=-1)
    assert (error > LEVELS).mean() <= OTHERS


def test_the_closed_loop_stays_as_close_to_the_target_as_before(expected, tmp_path):
    found = simulate(tmp_path / "run")
    for have, want in zip(found, expected["loop_psnr_db"], strict=True):
        assert have >= want - MARGIN_DB


if __name__ == "__main__":
    import tempfile

    import tests.conftest  # noqa: F401 - compiled as in the tests

    frames, psnr = make_clip()
    Image.fromarray(side_by_side(frames)).save(IMAGE)
    with tempfile.TemporaryDirectory() as folder:
        loop = simulate(Path(folder) / "run")
    figures = {"sha256": digests(), "clip_psnr_db": psnr, "loop_psnr_db": loop}
    EXPECTED.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
