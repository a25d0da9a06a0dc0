"""61 frames of 832 x 480 fused at 3 mm and rendered from their cameras, versus plain Open3D.

    python -m tests.benchmarks.bench_fusion

Each program runs in its own process, which reports how long it took, how much memory it held at
most beyond its input, and how long each of the 61 images takes. Plain Open3D: its own choice of
blocks, integration and extraction, and `project_to_rgbd_image`, one pixel a point; ours draws two.
"""

from __future__ import annotations

import multiprocessing
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from egosim_jax.geometry import invert
from egosim_jax.state.tsdf import Fusion
from egosim_jax.types import Cameras, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence
from egosim_jax.worlds.tabletop.scene import FIRST_HAND

SPEC = VideoSpec(frames=61, height=480, width=832, fps=16)
GOAL_S, GOAL_MS = 5.0, 15.0
Program = Literal["ours", "Open3D"]


@dataclass(frozen=True)
class Frames:
    """Inputs of fusion: depth without hands, colors, cameras."""

    depth_m: np.ndarray
    colors: np.ndarray
    cameras: Cameras


@dataclass(frozen=True)
class Figures:
    """Time, memory and result of a program."""

    fuse_s: float
    memory_mb: float
    points: int
    render_ms: float


def main(seed: int = 0) -> None:
    """Fuse and render with each program.

    Args:
        seed: Of the tabletop scene.
    """
    clip = next(make_sequence(seed, spec=SPEC))
    still = (clip.ids > 0) & (clip.ids < FIRST_HAND) & (clip.ids != clip.body_ids[clip.target])
    frames = Frames(np.where(still, clip.depth_m, 0).astype(np.float32), clip.frames, clip.cameras)
    del clip
    found: dict[Program, Figures] = {}
    for program in ("ours", "Open3D"):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            found[program] = pool.apply(measure, (program, frames))
    for name, one in found.items():
        print(
            f"{name:8s} fuse {one.fuse_s:5.1f} s, {one.memory_mb:6.0f} MB more at most, "
            f"{one.points:8d} points; render {one.render_ms:5.1f} ms a frame"
        )
    ours = found["ours"]
    met = ours.fuse_s <= GOAL_S, ours.render_ms <= GOAL_MS
    words = ["met" if one else "MISSED" for one in met]
    print(f"goals: {GOAL_S:.0f} s {words[0]}, {GOAL_MS:.0f} ms a frame {words[1]}")


def measure(program: Program, frames: Frames) -> Figures:
    """Fuse and render with one program."""
    import open3d  # noqa: F401  (its import is not timed)

    fuse, render = {"ours": (_fuse, _render), "Open3D": (_fuse_plainly, _render_plainly)}[program]
    Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")  # forget the most so far
    before = _memory_mb("VmRSS")
    start = time.perf_counter()
    points, colors = fuse(frames)
    fused = time.perf_counter() - start
    memory = _memory_mb("VmHWM") - before
    render(frames, points, colors)  # compiles, fills caches
    start = time.perf_counter()
    render(frames, points, colors)
    rendered = (time.perf_counter() - start) / len(frames.depth_m)
    return Figures(fused, memory, len(points), 1000 * rendered)


def _memory_mb(name: Literal["VmHWM", "VmRSS"]) -> float:
    """Return the process's memory: its peak since the last reset, or now."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith(name):
            return int(line.split()[1]) / 1024
    raise OSError(f"/proc/self/status has no {name}")


def _fuse(frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    from egosim_jax.state.tsdf import surface

    return surface(frames.depth_m, frames.colors, frames.cameras, fusion=Fusion())


def _fuse_plainly(frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    import open3d as o3d

    setting = Fusion()
    reach = setting.truncation_m / setting.voxel_m
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"),
        (o3d.core.float32,) * 3,
        (1, 1, 3),
        voxel_size=setting.voxel_m,
        block_resolution=16,
        block_count=10_000,
    )
    intrinsics = o3d.core.Tensor(frames.cameras.intrinsics_px)
    for frame, pose in enumerate(frames.cameras.world_from_camera):
        depth = o3d.t.geometry.Image(o3d.core.Tensor(frames.depth_m[frame]))
        color = o3d.t.geometry.Image(o3d.core.Tensor(frames.colors[frame].astype(np.float32)))
        extrinsics = o3d.core.Tensor(invert(pose))
        far = setting.max_depth_m
        blocks = grid.compute_unique_block_coordinates(
            depth, intrinsics, extrinsics, 1.0, far, reach
        )
        grid.integrate(blocks, depth, color, intrinsics, intrinsics, extrinsics, 1.0, far, reach)
    cloud = grid.extract_point_cloud(weight_threshold=setting.observations)
    return cloud.point.positions.numpy(), cloud.point.colors.numpy().astype(np.uint8)


def _render(frames: Frames, points: np.ndarray, colors: np.ndarray) -> None:
    import jax

    from egosim_jax.rendering import jitted

    on_device = jax.device_put(points)
    jax.block_until_ready(jitted.splat(on_device, frames.cameras, point_px=2))


def _render_plainly(frames: Frames, points: np.ndarray, colors: np.ndarray) -> None:
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    cloud.point["colors"] = o3d.core.Tensor(colors.astype(np.float32) / 255)
    intrinsics = o3d.core.Tensor(frames.cameras.intrinsics_px)
    for pose in frames.cameras.world_from_camera:
        image = cloud.project_to_rgbd_image(
            SPEC.width, SPEC.height, intrinsics, o3d.core.Tensor(invert(pose)),
            depth_scale=1.0, depth_max=100.0,
        )  # fmt: skip
        image.depth.as_tensor().numpy()


if __name__ == "__main__":
    tyro.cli(main)
