"""The place of a lifted object after a recorded clip, compared with the clip's last frame.

    egosim data annotate lift_tumbler.mp4 --out runs/lift
    python -m tests.benchmarks.bench_recorded runs/lift/lift_tumbler [--sheet SHEET.jpg]

The clip's own frames take the place of a generated clip: perception and fusion alone. They give the
object's place. The other estimate uses neither hands nor state updates: the object's image in the
first frame is shifted and scaled until it fits the last frame, and the scale gives the depth. This
needs a camera at rest, and an object that was not turned. Printed are both motions, the share
of the object's points within 2 cm of the other estimate, and the share left behind.
"""

from itertools import product
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro

from egosim_jax.annotate.to_episode import episode_from
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.geometry import invert, pixel_rays, project, transform
from egosim_jax.perception import registry
from egosim_jax.rendering.reference import render, splat
from egosim_jax.state.fuse import fuse
from egosim_jax.types import Cameras, Clip, SceneState, VideoSpec

NEAR_M = 0.02
"""Distance from the other estimate that counts as right, in meters."""
GRIDS = (
    (np.arange(0.9, 1.2, 0.01), np.arange(-40, 41, 4), np.arange(-40, 41, 4)),
    (np.arange(-0.01, 0.011, 0.005), np.arange(-3, 4), np.arange(-3, 4)),
)
"""Scales and shifts in pixels that are tried: all, and around the best one."""


def main(
    clip: Annotated[Path, tyro.conf.Positional],
    /,
    sheet: Path | None = None,
    height: int = 116,
    width: int = 208,
) -> None:
    """Perceive an annotated clip, and compare the object's place with the last frame.

    Args:
        clip: Folder of an annotated clip (`egosim data annotate`).
        sheet: File of a sheet: clip, state before and state after.
        height: Height of perceived frames in pixels.
        width: Width of perceived frames in pixels.
    """
    spec = VideoSpec(frames=61, height=height, width=width, fps=8)
    episode = episode_from(clip, spec)
    (action, *_), (truth, *_) = episode.actions, episode.ground_truth
    seen = Clip(frames=truth.frames, fps=spec.fps)
    perceived = registry.parse("classical").build()(seen, action, episode.state)
    if not perceived.world_from_object:
        raise SystemExit(f"nothing moved: {perceived.notes}")
    after = fuse(episode.state, perceived)
    large = episode_from(clip, VideoSpec(frames=61, height=4 * height, width=4 * width, fps=8))
    if large.first_frame is None:
        raise SystemExit(f"{clip} has no first frame without hands")
    last = large.ground_truth[0].frames[-1]
    for number, path in perceived.world_from_object.items():
        own = episode.state.points_m[episode.state.object_ids == number].astype(float)
        start = episode.state.world_from_object.get(number, np.eye(4))
        moved = transform(path[-1] @ invert(start), own)
        true = moved_as_seen(own, large.first_frame, last, large.actions[0].cameras)
        right = np.linalg.norm(moved - true, axis=1) <= NEAR_M
        print(
            f"object {number}: moved by {millimeters(own, moved)} mm, in the last frame by "
            f"{millimeters(own, true)} mm; {right.mean():.1%} of {len(own)} points within 2 cm, "
            f"{left_behind(after, number, len(own)):.1%} left behind"
        )
    if sheet is not None:
        views = [render(s, action.cameras, point_px=1).frames for s in (episode.state, after)]
        rows = SheetClip("clip, state before, state after", [truth.frames, *views])
        draw_sheet([rows], sheet, moments=np.linspace(0, 60, 6).astype(int).tolist())


def moved_as_seen(
    points_m: np.ndarray, first: np.ndarray, last: np.ndarray, cameras: Cameras
) -> np.ndarray:
    """Return the points after the motion that makes the first frame's object fit the last frame."""
    pose = cameras.world_from_camera[0]
    local = transform(invert(pose), points_m)
    center = local.mean(axis=0)
    u, v = (float(x) for x in project(cameras.intrinsics_px, center))
    one = Cameras(
        world_from_camera=pose[None],
        intrinsics_px=cameras.intrinsics_px,
        height=cameras.height,
        width=cameras.width,
    )
    drawn = splat(points_m, one, point_px=4)[1][0] >= 0
    around = cv2.dilate(drawn.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    row, column = np.nonzero(around)
    inside = drawn[row, column]
    before, after = (cv2.GaussianBlur(x, (0, 0), 1.5).astype(np.float32) for x in (first, last))
    shown = before[row, column]

    def cost(scale: float, right: float, down: float) -> float:
        x, y = (column - u) * scale + u + right, (row - v) * scale + v + down
        x, y = x.astype(np.float32)[None], y.astype(np.float32)[None]
        found = cv2.remap(after, x, y, cv2.INTER_LINEAR)
        apart = np.minimum(np.abs(found[0] - shown).mean(axis=1), 60)
        return float(apart[inside].mean() + apart[~inside].mean())

    best = (0.0, 0.0, 0.0)
    for grid in GRIDS:
        trials = [tuple(np.add(best, trial).tolist()) for trial in product(*grid)]
        best = min(trials, key=lambda trial: cost(*trial))
    scale, right, down = best
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    place = rays[round(v + down), round(u + right)] * center[2] / scale
    return points_m + pose[:3, :3] @ (place - center)


def left_behind(after: SceneState, number: int, count: int) -> float:
    """Return the share of an object's points that the state after the clip has no longer in it."""
    return max(0.0, 1 - int((after.object_ids == number).sum()) / count)


def millimeters(before: np.ndarray, after: np.ndarray) -> str:
    """Return the mean motion, for printing."""
    return ", ".join(f"{1000 * x:.0f}" for x in (after - before).mean(axis=0))


if __name__ == "__main__":
    tyro.cli(main)
