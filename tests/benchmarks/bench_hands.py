"""Hands on real videos: found, doubled and jumping ones, and distances to published skeletons.

    python -m tests.benchmarks.bench_hands DATA [--images DIR] [--only NAME ...] [--halves]

DATA has `raw_clips/lift_tumbler.mp4`, whose right hand is in frames 60 to 230, and `real_clips`
with `metadata.csv` and, per clip, `video.mp4` and `hand_keypoint_video.mp4`. The published joints
are the centers of the spheres in the latter, each known by the color of its finger. PCK15 is the
share of them that have a joint of ours, of the same finger, within 15 pixels. They are not ground
truth: some skeletons float next to the hand, and videos have crumbs of color. Hence also the
distance the other way, from our joints to the nearest published pixel of the same finger.

With `--halves`, costs of tracking are chosen on every second clip of each dataset and tried on the
other clips: the ones of the best mean PCK15 over the datasets, next to the defaults.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from egosim_jax.io.video import read_video
from egosim_jax.perception.video.estimates import RIGHT, HandTracks
from egosim_jax.perception.video.hands import LandmarkHands
from egosim_jax.perception.video.hands.track import TrackConfig
from egosim_jax.rendering.skeleton import SKELETONS

SPAN = slice(60, 231)
"""Frames of lift_tumbler.mp4 that have a hand."""
HUMAN = SKELETONS["human"]
FINGERS = np.stack([HUMAN.colors[4 * finger + 1] for finger in range(5)]).astype(np.float32)
PALETTE = FINGERS * 255 / FINGERS.max(-1, keepdims=True)
JOINTS = [[1, 2, 3, 4], [5, 6, 7, 8], [0, 9, 10, 11, 12], [13, 14, 15, 16], [17, 18, 19, 20]]
"""Joints that have the color of each finger: the wrist has the color of the middle finger."""
GRID = [
    TrackConfig(side=side, missing=missing, palm=palm)
    for side, missing, palm in product((0.25, 0.5, 1.0), (2.5, 3.5, 5.0), (0.25, 0.5, 1.0))
]
"""Costs of tracking that are compared."""


def finger_masks(frame: np.ndarray) -> np.ndarray:
    """Return the pixels of each finger's color, `5 h w`, whatever their brightness at an edge."""
    masks = np.zeros((5, *frame.shape[:2]), bool)
    bright = frame.max(-1) > 90
    colors = frame[bright].astype(np.float32)
    colors *= 255 / colors.max(-1, keepdims=True)
    distance = np.linalg.norm(colors[:, None] - PALETTE, axis=-1)
    nearest = distance.argmin(-1)
    for finger in range(5):
        masks[finger, bright] = (nearest == finger) & (distance[:, finger] < 60)
    return masks


def sphere_centers(masks: np.ndarray) -> list[np.ndarray]:
    """Return centers of each finger's spheres, `n 2`: places wider than the tubes around them."""
    rows, columns = (np.flatnonzero(masks.any((0, axis))) for axis in (2, 1))
    if not len(rows):
        return [np.zeros((0, 2))] * len(masks)
    top, left = max(rows[0] - 1, 0), max(columns[0] - 1, 0)
    masks = masks[:, top : rows[-1] + 2, left : columns[-1] + 2].astype(np.uint8)
    depths = [cv2.distanceTransform(mask, cv2.DIST_L2, 5) for mask in masks]
    radius = np.median([depth.max() for depth in depths if depth.max() > 2] or [np.inf])
    reach = 2 * round(1.5 * min(radius, 20)) + 1
    centers = []
    for depth in depths:
        smooth = cv2.GaussianBlur(depth, (0, 0), 1)
        ridge = (depth > 1) & (depth >= cv2.dilate(depth, np.ones((3, 3))) - 1e-3)
        around = (2 * reach + 1,) * 2
        count = cv2.boxFilter(ridge.astype(np.float32), -1, around, normalize=False)
        width = cv2.boxFilter(depth * ridge, -1, around, normalize=False) / np.maximum(count, 1)
        peaks = smooth >= cv2.dilate(smooth, np.ones((reach, reach)))
        peaks &= (depth >= 0.6 * radius) & (depth >= 1.15 * width)
        centers.append(np.argwhere(peaks)[:, ::-1] + np.array([left, top], float))
    return centers


def to_joints(tracks: HandTracks, centers: list[list[np.ndarray]]) -> np.ndarray:
    """Return distances from published joints, by frame and finger, to ours."""
    found = []
    for joints, frame in zip(tracks.joints_px, centers, strict=True):
        for finger, published in enumerate(frame):
            ours = joints[:, JOINTS[finger]].reshape(-1, 2)
            ours = ours[np.isfinite(ours).all(-1)]
            away = np.linalg.norm(published[:, None] - ours[None], axis=-1)
            found.append(away.min(1, initial=np.inf))
    return np.concatenate(found)


def to_pixels(tracks: HandTracks, masks: list[np.ndarray]) -> np.ndarray:
    """Return distances from our joints to the published pixels of the same finger."""
    found = [np.zeros(0)]
    for joints, frame in zip(tracks.joints_px, masks, strict=True):
        for finger, mask in enumerate(frame):
            ours = joints[:, JOINTS[finger]].reshape(-1, 2)
            ours = ours[np.isfinite(ours).all(-1)]
            if mask.any() and len(ours):
                field = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
                column, row = np.clip(
                    np.round(ours).astype(int), 0, np.array(field.shape)[::-1] - 1
                ).T
                found.append(field[row, column])
    return np.concatenate(found)


@dataclass(frozen=True)
class Tried:
    """One clip with each of the costs of tracking."""

    dataset: str
    half: int
    distances: dict[TrackConfig, np.ndarray]


def try_halves(clips: list[Tried]) -> None:
    """Print the PCK15 of each half, with costs that were chosen on the other one."""

    def pck(half: int, config: TrackConfig) -> dict[str, float]:
        found = defaultdict(list)
        for clip in clips:
            if clip.half == half:
                found[clip.dataset].append(clip.distances[config])
        return {name: float(np.mean(np.concatenate(d) < 15)) for name, d in found.items()}

    for half in (0, 1):
        best = max(GRID, key=lambda config: np.mean(list(pck(half, config).values())))
        for name, config in (("chosen there", best), ("default", TrackConfig())):
            shown = ", ".join(f"{k} {v:.3f}" for k, v in pck(1 - half, config).items())
            print(
                f"set on half {half}, tried on the other, {name} (side {config.side}, missing "
                f"{config.missing}, palm {config.palm}): PCK15 {shown}"
            )


def lift_tumbler(path: Path, estimator: LandmarkHands) -> None:
    """Print how many frames have the hand, doubles, and jumps."""

    def half(frame: np.ndarray) -> np.ndarray:
        return cv2.resize(frame, (960, 540), interpolation=cv2.INTER_AREA)

    frames = read_video(path, each=half).frames
    start = time.perf_counter()
    tracks = estimator(frames)
    seconds = time.perf_counter() - start
    there = tracks.presence > 0
    inside = there[SPAN]
    middle = tracks.joints_px.mean(-2)
    steps = np.linalg.norm(np.diff(middle, axis=0), axis=-1)
    print(
        f"lift_tumbler: {inside.any(1).sum()} of {len(inside)} frames, "
        f"{inside[:, RIGHT].sum()} right, {inside.all(1).sum()} double, "
        f"{(np.nan_to_num(steps) > 40).sum()} jumps over 40 px, "
        f"{there.any(1).sum() - inside.any(1).sum()} frames outside f60..f230, "
        f"{1000 * seconds / len(frames):.0f} ms a frame"
    )


def draw(frame: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return a frame with our skeletons."""
    image = frame.copy()
    for hand in joints[np.isfinite(joints).all((-1, -2))]:
        at = [tuple(int(v) for v in np.round(p)) for p in hand]
        for inner, outer in HUMAN.bones:
            color = tuple(int(v) for v in HUMAN.colors[outer])
            cv2.line(image, at[inner], at[outer], color, 2, cv2.LINE_AA)
            cv2.circle(image, at[outer], 4, color, -1, cv2.LINE_AA)
    return image


def write_sheet(path: Path, frames: np.ndarray, skeleton: np.ndarray, tracks: HandTracks) -> None:
    """Write an image of some frames: ours on the left, the published skeleton on the right."""
    rows = []
    for index in np.linspace(0, len(frames) - 1, 5).round().astype(int):
        ours = draw(frames[index], tracks.joints_px[index])
        drawn = finger_masks(skeleton[index]).any(0)[..., None]
        published = np.where(drawn, skeleton[index], frames[index])
        rows.append(np.concatenate([ours, published], axis=1))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.concatenate(rows)[..., ::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--images", type=Path)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--halves", action="store_true")
    args = parser.parse_args()
    estimator = LandmarkHands(weights=args.weights)
    if not args.only or "lift_tumbler" in args.only:
        lift_tumbler(args.data / "raw_clips" / "lift_tumbler.mp4", estimator)
    totals: dict[str, list[np.ndarray]] = defaultdict(list)
    tried: list[Tried] = []
    with (args.data / "real_clips" / "metadata.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["dataset"] != "agibot"]
    for row in rows:
        if args.only and not any(name in row["video_id"] for name in args.only):
            continue
        frames = read_video(args.data / "real_clips" / row["video"]).frames
        skeleton = read_video(args.data / "real_clips" / row["hand_keypoint_video"]).frames
        start = time.perf_counter()
        candidates = estimator.candidates(frames)
        tracks = estimator.tracks(candidates, len(frames))
        seconds = time.perf_counter() - start
        masks = [finger_masks(frame) for frame in skeleton]
        centers = [sphere_centers(mask) for mask in masks]
        to_ours, to_published = to_joints(tracks, centers), to_pixels(tracks, masks)
        half = len(totals[row["dataset"]]) % 2
        totals[row["dataset"]].append(to_ours)
        if args.halves:
            distances = {
                config: to_joints(
                    replace(estimator, tracking=config).tracks(candidates, len(frames)), centers
                )
                for config in GRID
            }
            tried.append(Tried(row["dataset"], half, distances))
        there = tracks.presence > 0
        print(
            f"{row['dataset']:7}{row['video_id'][:44]:45} left {there[:, 0].sum():2} right "
            f"{there[:, 1].sum():2} of {len(frames)}, published joints {len(to_ours):5}, "
            f"PCK15 {np.mean(to_ours < 15):.3f}, PCK25 {np.mean(to_ours < 25):.3f}, ours to "
            f"published {np.median(to_published) if len(to_published) else np.nan:5.1f} px, "
            f"{1000 * seconds / len(frames):.0f} ms a frame",
            flush=True,
        )
        if args.images:
            write_sheet(args.images / f"{row['video_id'][:60]}.jpg", frames, skeleton, tracks)
    for dataset, found in totals.items():
        joined = np.concatenate(found)
        print(
            f"{dataset}: {len(joined)} joints, PCK15 {np.mean(joined < 15):.3f}, "
            f"PCK25 {np.mean(joined < 25):.3f}; mean over clips "
            f"{np.mean([np.mean(f < 15) for f in found]):.3f}"
        )
    if args.halves:
        try_halves(tried)


if __name__ == "__main__":
    main()
