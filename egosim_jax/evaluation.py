"""Evaluation of generated clips: PSNR, SSIM and LPIPS against the ground truth, with baselines.

Every {id}.mp4 is compared with the recorded video of its metadata row over the same frames, both at
one size; so are the prior, the prior with a least-squares color fit, the first frame of the ground
truth repeated and, if there is an {id}_vae.mp4, the ground truth through the autoencoder. Frame 0
is excluded, because there the repeated frame is the ground truth.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from egosim_jax.batch import Window, read_results
from egosim_jax.data.metadata import ClipFiles
from egosim_jax.data.transforms import resize_image
from egosim_jax.io.run import write_json, write_text
from egosim_jax.io.video import probe_video, read_video
from egosim_jax.metrics import lpips
from egosim_jax.metrics.image import fit_colors
from egosim_jax.metrics.report import DEFINITIONS, print_table, score, summarize
from egosim_jax.progress import track
from egosim_jax.types import InputError

METHODS = {
    "generated": "generated",
    "prior": "prior",
    "prior_fit": "prior, colors fitted to the ground truth",
    "still": "first frame of the ground truth, repeated",
    "vae": "ground truth through the autoencoder",
}
"""Compared videos, and their names in tables."""
MEASURES = {"psnr": ("PSNR dB", "{:.2f}"), "ssim": ("SSIM", "{:.4f}"), **lpips.MEASURE}

Scores = dict[str, dict[str, float]]
"""Measures of one clip by method."""


class Evaluation(NamedTuple):
    """The result of an evaluation."""

    report: dict[str, Any]
    """Scores and protocol of an evaluation, the contents of report.json."""
    skipped: list[str]
    """Clips that were not compared, with the reasons."""

    def print(self) -> None:
        """Print a table for each split, and the protocol."""
        for split, methods in self.report["splits"].items():
            count = max(row["clips"] for row in methods.values())
            rows = {
                title: {key: methods[name][key] for key in MEASURES if key in methods[name]}
                for name, title in METHODS.items()
                if name in methods
            }
            print_table("", rows, MEASURES, title=f"{split}, {count} clips: mean ± spread")
        protocol = self.report["protocol"]
        first, last = protocol["frames"]
        sizes = ", ".join(protocol["pixels"])
        print(f"frames {first} to {last} at the size of the {protocol['size']}: {sizes}")
        print(f"lpips_alex: {protocol['lpips_alex']}")


def evaluate(
    generated: Path,
    clips: Sequence[ClipFiles],
    *,
    size: Literal["output", "target"] = "output",
    out: Path | None = None,
) -> Evaluation:
    """Compare the clips in a folder with their ground truth; write metrics.jsonl and report.json.

    Both files go to `out`, by default the folder of the clips. A clip that cannot be compared, or
    has another length than most, is skipped. Raises `InputError` if all are.
    """
    windows, skipped = _windows(generated, clips)
    windows, frames = _of_usual_length(generated, windows, skipped)
    compared: list[tuple[Window, Scores]] = []
    sizes: set[str] = set()
    for window in track(windows, "comparing", total=len(windows)):
        try:
            scores, height, width = _scores(generated, window, size)
            compared.append((window, scores))
            sizes.add(f"{width}x{height}")
        except InputError as error:
            skipped.append(f"{window.output_id}: {error}")
    for line in skipped:
        print(f"skipped: {line}", file=sys.stderr)
    if not compared:
        raise InputError(f"No clip in {generated} could be compared. (--generated)")

    lines = [
        {"video_id": window.output_id, "split": window.split, **scores}
        for window, scores in compared
    ]
    report = {
        "definitions": {**DEFINITIONS, "frames": "1 to the last"},
        "protocol": {
            "size": size,
            "pixels": sorted(sizes),
            "frames": [1, frames - 1],
            "resize": "Pillow LANCZOS, to the size of the comparison",
            "lpips_alex": lpips.protocol(),
        },
        "splits": _summarize([(window.split, scores) for window, scores in compared]),
    }
    out = out or generated
    write_text(out / "metrics.jsonl", "".join(f"{json.dumps(line)}\n" for line in lines))
    write_json(out / "report.json", report)
    return Evaluation(report, skipped)


def _windows(generated: Path, clips: Sequence[ClipFiles]) -> tuple[list[Window], list[str]]:
    """Return the generated windows of some clips, and why others were not generated."""
    if not generated.is_dir():
        raise InputError(f"There is no folder {generated}. (--generated)")
    rows = {files.video_id: files for files in clips}
    results = read_results(generated)
    if results is None:
        return [Window(files, 0, video_id) for video_id, files in rows.items()], []
    windows, skipped = [], []
    for output_id, line in results.items():
        files = rows.get(str(line.get("source_id")))
        if files is None:
            continue
        if line.get("status") == "failed":
            skipped.append(f"{output_id}: its generation failed")
        else:
            windows.append(Window(files, line.get("start", 0), output_id))
    return windows, skipped


def _of_usual_length(
    generated: Path, windows: Sequence[Window], skipped: list[str]
) -> tuple[list[Window], int]:
    """Return the windows of the most frequent length, and that length; extend `skipped`."""
    lengths: dict[Window, int] = {}
    for window in windows:
        try:
            lengths[window] = probe_video(generated / f"{window.output_id}.mp4").frames
        except InputError as error:
            skipped.append(f"{window.output_id}: {error}")
    counts = Counter(lengths.values())
    usual = max(counts, key=lambda length: (counts[length], length), default=0)
    skipped += [
        f"{window.output_id}: it has {length} frames, most clips {usual}."
        for window, length in lengths.items()
        if length != usual
    ]
    if usual == 1:
        raise InputError("Clips of one frame cannot be compared: frame 0 is excluded.")
    return [window for window in lengths if lengths[window] == usual], usual


def _scores(generated: Path, window: Window, size: str) -> tuple[Scores, int, int]:
    """Return the scores of a clip, and the height and width at which it was compared."""
    path = generated / f"{window.output_id}.mp4"
    if window.files.target is None:
        raise InputError(f"{window.files.row} has no ground truth. (column video)")
    output = probe_video(path)
    like = output if size == "output" else probe_video(window.files.target)
    shape = output.frames, like.height, like.width
    target = _read_at(window.files.target, shape, window.start)
    prior = _read_at(window.files.prior, shape, window.start)
    videos = {
        "generated": _read_at(path, shape, 0),
        "prior": prior,
        "prior_fit": fit_colors(prior, target),
        "still": np.broadcast_to(target[:1], target.shape),
    }
    vae = path.with_name(f"{path.stem}_vae.mp4")
    if vae.exists():
        videos["vae"] = _read_at(vae, shape, 0)
    scores = {
        method: {**score(video[1:], target[1:]), **lpips.score(video[1:], target[1:])}
        for method, video in videos.items()
    }
    return scores, like.height, like.width


def _read_at(path: Path, shape: tuple[int, int, int], start: int) -> np.ndarray:
    """Read the frames of a video from `start`, as many as `shape` has, resized to its size."""
    count, height, width = shape
    fit = partial(resize_image, height=height, width=width)
    frames = read_video(path, start=start, stop=start + count, each=fit).frames
    if len(frames) < count:
        raise InputError(f"{path} ends before frame {start + count}, which was generated.")
    return frames


def _summarize(clips: Sequence[tuple[str, Scores]]) -> dict[str, dict[str, dict[str, Any]]]:
    """Summarize each method over the clips of each split, in the order of the splits' names."""
    gathered: dict[str, dict[str, list[Mapping[str, float]]]] = {}
    for split, scores in clips:
        for method, measures in scores.items():
            gathered.setdefault(split, {}).setdefault(method, []).append(measures)
    return {
        split: {
            method: {"clips": len(scores), **summarize(scores, MEASURES)}
            for method, scores in methods.items()
        }
        for split, methods in sorted(gathered.items())
    }
