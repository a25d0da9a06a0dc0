"""Crops of the recorded images that a method's images show."""

import csv
import io
import json

import cv2
import numpy as np
import pytest
from PIL import Image

from egosim_jax.cli.evaluate import Evaluate
from egosim_jax.cli.table import TableCommand
from egosim_jax.evaluation.methods import WHOLE, Edges
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.evaluation.registration import find_crop
from egosim_jax.io.writing import write_video
from egosim_jax.runtime.command import ExitCode

HEIGHT, WIDTH = 96, 160


@pytest.fixture(autouse=True)
def without_lpips(monkeypatch):
    """Compare by pixels alone: networks are slow in the tests' programs."""
    monkeypatch.setattr(lpips, "load_if_installed", lambda name: None)


def recorded(seed, frames=8):
    """Return a texture that drifts by a pixel a frame, with a bright ball that moves across it."""
    rng = np.random.default_rng(seed)
    size = (HEIGHT + frames, WIDTH + frames)
    noise = [cv2.GaussianBlur(rng.normal(size=(*size, 3)), (0, 0), s) * s for s in (2, 5, 12)]
    texture = np.sum(noise, axis=0)
    texture = np.uint8(np.clip(125 + 45 * texture / texture.std(), 0, 255))
    found = []
    for k in range(frames):
        frame = np.ascontiguousarray(texture[k : k + HEIGHT, k : k + WIDTH])
        center = 20 + 15 * k, 30 + 4 * k
        found.append(cv2.circle(frame, center, 9, (250, 220, 40), -1))
    return np.stack(found)


def shown(video, box, size):
    """Return the part `box` of every frame, edges in pixels, at a size: width and height."""
    left, top, right, bottom = box
    across = [int(max(-left, 0)), int(max(right - WIDTH, 0))]
    down = [int(max(-top, 0)), int(max(bottom - HEIGHT, 0))]
    padded = np.pad(video, ((0, 0), down, across, (0, 0)))
    box = (left + across[0], top + down[0], right + across[0], bottom + down[0])
    resized = [Image.fromarray(f).resize(size, Image.Resampling.LANCZOS, box) for f in padded]
    return np.stack([np.asarray(frame) for frame in resized])


KINDS = {
    "center square": ((32, 0, 128, 96), (64, 64)),
    "center 16:10 with margins": ((20.5, 8, 139.5, 88), (96, 60)),
    "off center": ((10, 20, 110, 90), (100, 70)),
    "zoomed at the full size": ((24, 14.4, 136, 81.6), (160, 96)),
    "squeezed by four percent": ((3, 0, 157, 96), (160, 96)),
    "whole, stretched to a square": ((0, 0, 160, 96), (64, 64)),
    "whole, letterboxed": ((0, -32, 160, 128), (64, 64)),
}


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        *(("equal", kind) for kind in KINDS),
        ("darker", "zoomed at the full size"),
        ("delayed", "whole, letterboxed"),
        ("one wrong clip", "squeezed by four percent"),
    ],
)
def test_a_crop_is_found(change, kind):
    box, size = KINDS[kind]
    pairs = []
    for seed in range(3):
        true = recorded(seed)
        video = shown(true, box, size)
        if change == "darker":
            video = video // 2 + 30
        if change == "delayed":
            video = video[[0, 0, 0, 1, 2, 3, 4, 5]]
        if change == "one wrong clip" and seed == 2:
            video = shown(recorded(9), (0, 0, 160, 96), size)
        pairs.append((video[::3], true))
    found = find_crop(pairs)
    assert found.found
    assert found.crop.pixels(HEIGHT, WIDTH) == pytest.approx(box, abs=0.8)


def test_noise_shows_no_crop():
    rng = np.random.default_rng(0)
    pairs = [(rng.integers(0, 256, (3, 64, 64, 3), np.uint8), recorded(n)) for n in range(3)]
    found = find_crop(pairs)
    assert (found.crop, found.found) == (WHOLE, False)


@pytest.mark.parametrize("sigma", [1, 3])
def test_a_blurred_or_noisy_whole_image_stays_whole(sigma):
    rng = np.random.default_rng(0)
    pairs = []
    for seed in range(3):
        true = recorded(seed)
        video = np.stack([cv2.GaussianBlur(frame, (0, 0), sigma) for frame in true[::3]])
        video = np.clip(video + rng.normal(0, 12, video.shape), 0, 255).astype(np.uint8)
        pairs.append((video, true))
    assert find_crop(pairs).crop == WHOLE


def test_crops_intersect_and_are_relative():
    one, other = Edges(0.1, 0.0, 0.7, 1.0), Edges(0.3, 0.25, 1.0, 0.75)
    assert one.common(other) == Edges(0.3, 0.25, 0.7, 0.75)
    assert other.common(other).within(other) == pytest.approx((0, 0, 1, 1))
    assert Edges(0.2, 0.1, 0.8, 0.9).whole_pixels(24, 32).pixels(24, 32) == (7, 3, 25, 21)


@pytest.fixture
def metadata(tmp_path):
    """Metadata of three recorded clips, and folders of methods."""
    names = [f"clip{number}" for number in range(3)]
    lines = ["video,ego_prior_video,hand_keypoint_video,first_frame,prompt,video_id,dataset"]
    for seed, name in enumerate(names):
        true = recorded(seed)
        write_video(tmp_path / name / "video.mp4", true, 16, crf=0)
        write_video(tmp_path / name / "other.mp4", true // 2, 16)
        Image.fromarray(true[0]).save(tmp_path / name / "first.png")
        files = f"{name}/video.mp4,{name}/other.mp4,{name}/other.mp4,{name}/first.png"
        lines.append(f"{files},a prompt,{name},egodex")
        methods = {"wide": KINDS["whole, stretched to a square"],
                   "left": ((0, 0, 110, 96), (110, 96)),
                   "square": KINDS["center square"]}  # fmt: skip
        for method, (box, size) in methods.items():
            write_video(tmp_path / method / f"{name}.mp4", shown(true, box, size), 16, crf=0)
    path = tmp_path / "metadata.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def rows_of(out):
    rows = csv.DictReader(io.StringIO((out / "scores.csv").read_text()))
    return {(row["video_id"], row["method"]): row for row in rows}


def test_a_table_compares_inside_the_common_crop_and_in_own_crops(metadata, tmp_path, capsys):
    folders = tuple(str(tmp_path / name) for name in ("wide", "left", "square"))
    options = {"metadata": metadata, "page_clips": 0, "lpips": (), "baselines": ("still",)}
    out = tmp_path / "out"
    made = TableCommand(name="egosim", generated=folders, out=out, **options)
    assert made.run() == ExitCode.DONE
    rows = rows_of(out)
    for method in ("wide", "left", "square", "still"):
        row = rows["clip1", method]
        # columns 32 to 110, each edge found to a pixel and rounded inward
        assert int(row["width"]) == pytest.approx(78, abs=3)
        assert int(row["height"]) == pytest.approx(96, abs=1)
    assert float(rows["clip1", "left"]["psnr"]) > 30  # stretched, it has 13
    assert float(rows["clip1", "square"]["psnr"]) > 25
    assert int(rows["clip1", "left_own"]["width"]) == pytest.approx(110, abs=1)
    assert int(rows["clip1", "wide_own"]["width"]) == 160
    assert ("clip1", "still_own") not in rows
    report = json.loads((out / "report.json").read_text())
    assert "wide, egodex: the whole image" in report["protocol"]["crops"][0]
    assert report["protocol"]["crops"][1].startswith("left, egodex: columns ")
    assert set(report["differences"]["egodex"]) == {"left", "square", "still"}
    printed = capsys.readouterr().out
    assert "square, in its own crop" in printed
    assert "crop: square, egodex: columns" in printed


def test_evaluate_crops_the_ground_truth_of_a_cropped_output(metadata, tmp_path):
    out = tmp_path / "out"
    options = {"metadata": metadata, "page_clips": 0, "lpips": (), "baselines": ()}
    Evaluate(generated=(str(tmp_path / "square"),), out=out, **options).run()
    row = rows_of(out)["clip0", "generated"]
    assert (row["width"], row["height"]) == ("64", "64")
    assert float(row["psnr"]) > 28  # against the whole ground truth, stretched, it has 13


@pytest.mark.parametrize(
    ("fps", "compared"), [(16, True), (15.95, True), (8, False), (30, False), (17, False)]
)
def test_frame_rates_are_compared(metadata, tmp_path, fps, compared, capsys):
    for number in range(3):
        write_video(tmp_path / "timed" / f"clip{number}.mp4", recorded(number), fps)
    options = {"metadata": metadata, "page_clips": 0, "lpips": (), "baselines": ()}
    write_video(tmp_path / "timed" / "clip0.mp4", recorded(0), 16)
    run = Evaluate(generated=(str(tmp_path / "timed"),), **options).run
    assert run() == (ExitCode.DONE if compared else ExitCode.PARTIAL)
    said = capsys.readouterr().err
    assert (f"has {fps} frames a second, the ground truth 16" in said) != compared
    assert ("-vf fps=" in said) != compared


def test_seeds_of_one_method_are_averaged(metadata, tmp_path):
    for number in range(3):
        true = recorded(number)
        for seed, offset in enumerate((4, 8, 16)):
            video = np.clip(true.astype(int) + offset, 0, 255).astype(np.uint8)
            write_video(tmp_path / f"s{seed}" / f"clip{number}.mp4", video, 16, crf=0)
    text = metadata.read_text().replace("egodex", "real_static")
    metadata.write_text(text)
    options = {"metadata": metadata, "page_clips": 0, "lpips": (), "baselines": ()}
    out = tmp_path / "out"
    folders = [str(tmp_path / f"s{seed}") for seed in range(3)]
    TableCommand(name="dwm_1", generated=tuple(folders), out=out, **options).run()
    alone = [float(rows_of(out)["clip2", f"s{seed}"]["psnr_clip"]) for seed in range(3)]
    seeds = tuple(f"dwm={folder}" for folder in folders)
    TableCommand(name="dwm_1", generated=seeds, out=out, **options).run()
    rows = rows_of(out)
    assert len(rows) == 3
    assert float(rows["clip2", "dwm"]["psnr_clip"]) == pytest.approx(np.mean(alone))
    assert "dwm, mean of 3 seeds" in (out / "table.tex").read_text()
