"""Rung, verdict and figures of the camera ladder on eight real clips, and the gate's two halves.

    python -m tests.benchmarks.bench_cameras FOLDER [--clips NAME ...] [--threads 1]

FOLDER has dwm_triplets, real_clips and raw_clips. The hands of the published hand videos, widened
and prolonged to the lower border, are masked. Each clip has the rungs that are right for it; any
other one is printed as WRONG, and so is a focal length that is off by a tenth of the device's. At
the end, the gate's figures of accepted and of refused reconstructions for each half of the clips:
a threshold that is between them in the first half is tried on the second.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from egosim_jax.io.video import read_video
from egosim_jax.perception.cameras import CameraLadder, ColmapConfig
from egosim_jax.perception.estimates import CameraEstimate, Rung, Verdict


@dataclass(frozen=True)
class Clip:
    """Video, masks and what is known of its camera."""

    folder: str
    hands: str | None
    right: tuple[Rung, ...]
    half: int
    focal_px: float | None = None
    """Focal length of the device, known or agreed on by its other clips."""
    device: bool = False
    """True if the ladder is given the focal length."""


SFM: tuple[Rung, ...] = ("incremental", "focal", "global")
STUCK: tuple[Rung, ...] = ("rotation", "refused")
DWM, EGODEX = "dwm_triplets", "real_clips/egodex"
SKELETON = "hand_keypoint_video.mp4"
CLIPS = {
    "00017": Clip(f"{DWM}/00017", "hands.mp4", SFM, 1, 300),
    "00039": Clip(f"{DWM}/00039", "hands.mp4", SFM, 2, 300),
    "00055": Clip(f"{DWM}/00055", "hands.mp4", (*SFM, "refused"), 2, 300, True),
    "declutter": Clip(f"{EGODEX}/declutter_desk_8_0_120", SKELETON, SFM, 1, 323),
    "task12": Clip("real_clips/egocap/task12_rollout_clip_1_0.5_4.5", SKELETON, SFM, 2, 382),
    "insert_remove": Clip(
        f"{EGODEX}/insert_remove_bookshelf_18_0_120", SKELETON, STUCK, 1, 323, True
    ),
    "pick_place": Clip(f"{EGODEX}/basic_pick_place_178_0_73", SKELETON, STUCK, 2, 323, True),
    "lift_tumbler": Clip("raw_clips/lift_tumbler.mp4", None, ("static",), 1),
}


def main(
    folder: tyro.conf.Positional[Path],
    clips: tuple[str, ...] = tuple(CLIPS),
    threads: int = -1,
    out: Annotated[Path | None, tyro.conf.arg(help="Folder for an npz of each estimate.")] = None,
) -> None:
    """Estimate the cameras of each clip and compare the verdicts with what is right.

    Args:
        folder: With the real clips.
        clips: Names of those to run.
        threads: Of COLMAP; 1 makes it reproducible.
    """
    wrong, tried = 0, []
    for name in clips:
        clip = CLIPS[name]
        frames, moving = load(folder, clip)
        ladder = CameraLadder(colmap=ColmapConfig(threads=threads))
        start = time.monotonic()
        found = ladder(frames, moving, focal_px=clip.focal_px if clip.device else None)
        seconds = time.monotonic() - start
        right = is_right(found, clip)
        wrong += not right
        print(
            f"{name} (half {clip.half}): {found.verdict.rung}, {'right' if right else 'WRONG'}, "
            f"{seconds:.0f} s\n  {found.verdict.reason}"
        )
        print("  " + json.dumps({n: float(f"{v:.4g}") for n, v in found.verdict.figures.items()}))
        tried.append((clip.half, found.verdict))
        if out is not None:
            save(out / f"{name}.npz", found)
    print(f"{len(clips) - wrong} of {len(clips)} verdicts right")
    print("\n".join(margins(tried)))


def margins(tried: list[tuple[int, Verdict]]) -> list[str]:
    """Return a line for each figure of the gate: its values where accepted and where refused."""
    lines = []
    for half in (1, 2):
        for figure in ("registered", "depth_spread", "radial", "angle_deg", "step", "view_deg"):
            values: dict[bool, list[float]] = {True: [], False: []}
            for _, verdict in (one for one in tried if one[0] == half):
                for rung in SFM:
                    if (value := verdict.figures.get(f"{rung}_{figure}")) is not None:
                        values[rung == verdict.rung].append(value)
            good, bad = (" ".join(f"{v:.3g}" for v in sorted(values[k])) for k in (True, False))
            lines.append(f"half {half} {figure}: accepted {good or '-'}; refused {bad or '-'}")
    return lines


def load(folder: Path, clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Return a clip's frames, half as large above 1280 pixels, and its mask of hands and arms."""
    import cv2

    path = folder / clip.folder
    if clip.hands is None:
        frames = read_video(path, each=lambda f: np.ascontiguousarray(f[::2, ::2])).frames
        return frames, np.zeros(frames.shape[:3], bool)
    frames = read_video(path / "video.mp4").frames
    hands = read_video(path / clip.hands).frames[: len(frames)]
    kernel = np.ones((41, 41), np.uint8)
    drawn = (hands.max(axis=-1) > 60).astype(np.uint8)
    wide = np.stack([cv2.dilate(mask, kernel) for mask in drawn])
    return frames, np.maximum.accumulate(wide, axis=1) > 0


def is_right(found: CameraEstimate, clip: Clip) -> bool:
    """Return whether a verdict is one of the right ones, with a focal length near the known one."""
    rung = found.verdict.rung
    if rung not in clip.right:
        return False
    if rung not in SFM or clip.focal_px is None:
        return True
    focal = found.verdict.figures[f"{rung}_focal_px"]
    return abs(focal / clip.focal_px - 1) < 0.1


def save(path: Path, found: CameraEstimate) -> None:
    """Write an estimate as arrays."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {"figures": np.array(list(found.verdict.figures.values()))}
    if found.cameras is not None:
        arrays |= {n: getattr(found.cameras, n) for n in ("world_from_camera", "intrinsics_px")}
    if found.points is not None:
        arrays |= vars(found.points)
    np.savez(path, **arrays)


if __name__ == "__main__":
    tyro.cli(main)
