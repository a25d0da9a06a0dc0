"""Folders of finished trainings, written without training."""

import json
from pathlib import Path

import numpy as np

from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.io.video import write_video

HOSTILE = "<script>alert(1)</script>"


def write_stage(folder: Path, *, steps: int = 40, samples: tuple[int, ...] = ()) -> Path:
    """Write the files of a finished training."""
    folder.mkdir(parents=True)
    lines = [
        {"step": step, "loss": 2 / step, "lr": 1e-3, "grad_norm": 0.5, "step_time_s": 0.25}
        for step in range(10, steps + 1, 10)
    ]
    lines += [{"step": step, "validation_loss": 3 / (step + 1)} for step in (0, steps)]
    (folder / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    config = {"training": {"type": "TrainConfig", "steps": steps, "batch_size": 8, "note": HOSTILE}}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "environment.json").write_text(json.dumps({"packages": {"jax": "0.10.2"}}))
    (folder / "times.json").write_text(json.dumps({"compiling": 6.0, "updates": 2.0}))
    red = np.broadcast_to(np.array([220, 0, 0], np.uint8), (9, 64, 96, 3))
    for step in samples:
        path = folder / "samples" / f"step_{step:06d}.mp4"
        write_video(path, red, 8)
        draw_sheet([SheetClip("clip", [red])], path.with_suffix(".png"), moments=(0, 8))
    return folder
