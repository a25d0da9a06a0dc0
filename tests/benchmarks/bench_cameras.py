"""Rung, verdict and figures of the camera ladder on eight real clips, and the gate tried by halves.

    python -m tests.benchmarks.bench_cameras FOLDER [--clips NAME ...] [--threads 1] [--out DIR]
    python -m tests.benchmarks.bench_cameras FOLDER --verdicts DIR/verdicts.json

FOLDER has dwm_triplets, real_clips and raw_clips. The hands of the published hand videos, widened
and prolonged to the lower border, are masked. Each clip has the rungs that are right for it; any
other one is printed as WRONG, and so is a focal length that is off by a tenth of the device's.

At the end thresholds are set on half of the clips and tried on the other half. A reconstruction is
right if its clip has a right one and its focal length is the device's. The threshold of each figure
is `--margin` times the worst of the right ones in the half; thresholds of the view are fixed.
The second command does this with verdicts of an earlier run.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from egosim_jax.io.video import read_video
from egosim_jax.perception.video.cameras import CameraLadder, ColmapConfig
from egosim_jax.perception.video.cameras.gate import GateConfig, refusals
from egosim_jax.perception.video.estimates import CameraEstimate, Rung


@dataclass(frozen=True)
class Clip:
    """Video, masks and the known parts of its camera."""

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

LIMITS = {
    "max_depth_spread": ("depth_spread", True),
    "max_radial": ("radial", True),
    "max_step": ("step", True),
    "min_angle_deg": ("angle_deg", False),
    "min_registered": ("registered", False),
    "min_shared": ("shared", False),
}
"""Figure of each threshold, and True if that is the largest value, False if the smallest."""


@dataclass(frozen=True)
class Attempt:
    """A reconstruction of a clip by one rung."""

    figures: Mapping[str, float]
    right: bool
    calibrated: bool


def main(
    folder: tyro.conf.Positional[Path],
    clips: tuple[str, ...] = tuple(CLIPS),
    threads: int = -1,
    out: Annotated[Path | None, tyro.conf.arg(help="Folder for an npz of each estimate.")] = None,
    margin: float = 2.0,
    verdicts: Annotated[Path | None, tyro.conf.arg(help="Figures of an earlier run.")] = None,
) -> None:
    """Estimate the cameras of each clip and compare the verdicts with the ground truth.

    Args:
        folder: With the real clips.
        clips: Names of those to run.
        threads: Of COLMAP; 1 makes it reproducible.
        margin: Of thresholds that are set on half of the clips.
    """
    if verdicts is not None:
        print("\n".join(try_halves(json.loads(verdicts.read_text()), margin)))
        return
    wrong, tried = 0, {}
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
        tried[name] = dict(found.verdict.figures)
        if out is not None:
            save(out / f"{name}.npz", found)
            (out / "verdicts.json").write_text(json.dumps(tried))
    print(f"{len(clips) - wrong} of {len(clips)} verdicts right")
    print("\n".join(try_halves(tried, margin)))


def attempts(verdicts: Mapping[str, Mapping[str, float]], half: int) -> list[Attempt]:
    """Return the reconstructions of the clips of a half, with their figures."""
    found = []
    for name, figures in verdicts.items():
        clip = CLIPS[name]
        for rung in SFM if clip.half == half else ():
            own = {
                figure.removeprefix(f"{rung}_"): value
                for figure, value in figures.items()
                if figure.startswith(f"{rung}_")
            }
            if own:
                right = rung in clip.right and _near(own["focal_px"], clip.focal_px)
                found.append(Attempt(own, right, clip.device and rung != "incremental"))
    return found


def fit(tried: Sequence[Attempt], margin: float) -> GateConfig:
    """Return the gate whose thresholds are a margin away from the worst right reconstruction."""
    limits = {}
    for limit, (figure, largest) in LIMITS.items():
        values = [abs(one.figures[figure]) for one in tried if one.right]
        limits[limit] = max(values) * margin if largest else min(values) / margin
    return GateConfig(**{**limits, "min_shared": math.ceil(limits["min_shared"])})


def try_halves(verdicts: Mapping[str, Mapping[str, float]], margin: float) -> list[str]:
    """Return lines on thresholds that are set on one half and tried on the other."""
    halves = {half: attempts(verdicts, half) for half in (1, 2)}
    lines = []
    for own, other in ((1, 2), (2, 1)):
        gate = fit(halves[own], margin)
        shown = ", ".join(f"{limit} {getattr(gate, limit):.3g}" for limit in LIMITS)
        lines += [
            f"set on half {own}: {shown}",
            f"  tried on half {other}: {_judge(halves[other], gate)}",
        ]
    both = [*halves[1], *halves[2]]
    return [*lines, f"the gate's own thresholds on both: {_judge(both, GateConfig())}"]


def _judge(tried: Sequence[Attempt], gate: GateConfig) -> str:
    accepted = [not refusals(one.figures, gate, calibrated=one.calibrated) for one in tried]
    counts = [
        (sum(a for one, a in zip(tried, accepted, strict=True) if one.right == right),
         sum(one.right == right for one in tried))
        for right in (True, False)
    ]  # fmt: skip
    (right, rights), (wrong, wrongs) = counts
    return f"{right} of {rights} right ones accepted, {wrong} of {wrongs} wrong ones accepted"


def _near(focal_px: float, known_px: float | None) -> bool:
    return known_px is None or abs(focal_px / known_px - 1) < 0.1


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
    return rung not in SFM or _near(found.verdict.figures[f"{rung}_focal_px"], clip.focal_px)


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
