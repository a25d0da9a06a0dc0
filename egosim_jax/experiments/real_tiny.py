"""`egosim experiment real_tiny`: train a small model on recorded clips and compare its clips.

`egosim experiment debug` does the same in a few minutes, with the model `debug` on synthetic clips.

Each clip is also generated with the prior, mask and hands of another clip. The drop of the scores
measures how much the model uses its conditions.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from egosim_jax import configs
from egosim_jax.data.clip_files import ClipFiles
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.data.windows import read_results, windows_of
from egosim_jax.evaluation.evaluate import evaluate
from egosim_jax.experiments.config import Debug, RealTiny
from egosim_jax.generation.batch import BatchJob
from egosim_jax.io.run import write_json, write_text
from egosim_jax.io.video import read_video
from egosim_jax.runtime.terminal import print_line
from egosim_jax.train.from_scratch import SYNTHETIC_CLIPS
from egosim_jax.train.recipes import DEBUG, REAL_TINY

SHEET_FRAMES = (4, 10, 16)
"""Frames of each clip on the contact sheet."""


def run(settings: RealTiny | Debug) -> None:
    """Train, generate, compare and draw."""
    out, seed = settings.out, settings.seed
    if isinstance(settings, RealTiny):
        starts, size = settings.start, settings.batch_size
        replace(REAL_TINY, metadata=settings.metadata, out=out).run()
        compare("real_tiny", settings.metadata, out, starts=starts, seed=seed, batch_size=size)
        return
    vae = replace(DEBUG.vae, steps=settings.steps)
    denoiser = replace(DEBUG.denoiser, steps=settings.steps)
    replace(DEBUG, out=out, vae=vae, denoiser=denoiser).run()
    compare("debug", out / SYNTHETIC_CLIPS, out, starts=(0,), seed=seed, batch_size=2)


def compare(
    config: str, metadata: Path, out: Path, *, starts: Sequence[int], seed: int, batch_size: int
) -> None:
    """Generate the clips with their own and with swapped conditions; compare both, and draw.

    The model is the one in `out`. Writes report.json and contact_sheet.png.
    """

    def report_of(name: str, metadata: Path) -> dict[str, Any]:
        clips, folder, weights = read_metadata(metadata), out / name, out / "weights"
        job = BatchJob(
            model=configs.get(config).at(weights),
            out=folder,
            weights=weights,
            seed=seed,
            batch_size=batch_size,
            skip_existing=True,
            reconstruct=name == "generated",
        )
        job.open()
        job.generate(windows_of(clips, starts))
        print_line(name)
        evaluation = evaluate(folder, clips)
        evaluation.print()
        return evaluation.report

    reports = {
        "generated": report_of("generated", metadata),
        "swapped": report_of("swapped", _swap(metadata, out / "swapped.jsonl")),
    }
    for split, methods in reports["generated"]["splits"].items():
        with_own, with_other = (
            rows["generated"]["psnr"]["mean"]
            for rows in (methods, reports["swapped"]["splits"][split])
        )
        print(f"{split}: another clip's prior and hands cost {with_own - with_other:.2f} dB")
    write_json(out / "report.json", reports)
    sheet = out / "contact_sheet.png"
    draw_sheet(list(_sheet_clips(out / "generated")), sheet, moments=SHEET_FRAMES)
    print_line(sheet)


def _swap(metadata: Path, path: Path) -> Path:
    """Write metadata in which each clip has the conditions of the next clip in its split."""
    items = read_metadata(metadata)
    lines = []
    for split in sorted({item.extra["split"] for item in items}):
        clips = [item for item in items if item.extra["split"] == split]
        for clip, other in zip(clips, [*clips[1:], clips[0]], strict=True):
            lines.append(json.dumps(_row(clip, other)))
    write_text(path, "".join(f"{line}\n" for line in lines))
    return path


def _row(clip: ClipFiles, other: ClipFiles) -> dict[str, str]:
    """Return a metadata row with another clip's hands and prior, and so the mask next to it."""
    return {
        "video": str(clip.target and clip.target.resolve()),
        "ego_prior_video": str(other.prior.resolve()),
        "hand_keypoint_video": str(other.hands.resolve()),
        "first_frame": str(clip.first_frame.resolve()),
        "prompt": clip.prompt,
        "video_id": clip.video_id,
        **clip.extra,
    }


def _sheet_clips(folder: Path) -> Iterator[SheetClip]:
    """Yield one comparison video per clip, sorted by split and id."""
    results = read_results(folder) or {}
    shown = {
        line["source_id"]: line for line in reversed(results.values()) if line["status"] == "done"
    }
    for line in sorted(shown.values(), key=lambda x: (x.get("split", ""), x["video_id"])):
        title = (
            f"{line.get('split', '')}  {line['video_id']}  prior | hands | generated | ground truth"
        )
        yield SheetClip(title, [read_video(folder / f"{line['video_id']}_cmp.mp4").frames])
