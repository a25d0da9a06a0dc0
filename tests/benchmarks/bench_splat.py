"""A million points at 832 x 480: NumPy, JAX and Open3D, milliseconds a frame.

    python -m tests.benchmarks.bench_splat [--rounds 9]

Open3D's `project_to_rgbd_image` draws one pixel a point; ours draws points of one and two pixels.
The programs take turns, so that a busy neighbor slows them alike.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import jax
import numpy as np
import tyro

from egosim_jax.geometry import invert, look_at
from egosim_jax.rendering import jitted, reference
from egosim_jax.types import Cameras

POINTS, HEIGHT, WIDTH = 1_000_000, 480, 832
GOAL_MS = 15.0
"""For the JAX renderer with points of one pixel."""


def main(rounds: int = 9) -> None:
    """Time each renderer.

    Args:
        rounds: Times that each is run, after one that compiles.
    """
    programs = make_programs()
    for program in programs.values():
        program()
    times: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds):
        for name, program in programs.items():
            start = time.perf_counter()
            program()
            times[name].append(1000 * (time.perf_counter() - start))
    for name, values in times.items():
        print(f"{name:24s} {median(values):6.1f} ms [{min(values):.1f}, {max(values):.1f}]")
    best = median(times["JAX, 1 pixel"])
    print(f"goal {GOAL_MS:.0f} ms: {'met' if best <= GOAL_MS else 'MISSED'}")


def make_programs() -> dict[str, Callable[[], object]]:
    """The timed calls; each returns when its image is there."""
    import open3d as o3d

    rng = np.random.default_rng(0)
    points = rng.uniform([-1, 0, 0], [1, 1, 0.4], (POINTS, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (POINTS, 3), dtype=np.uint8)
    pose = look_at(np.array([0, -0.4, 0.7]), np.array([0, 0.5, 0.1]), up=np.array([0, 0, 1.0]))
    cameras = Cameras(
        world_from_camera=pose[None],
        intrinsics_px=np.array([[600.0, 0, 415.5], [0, 600.0, 239.5], [0, 0, 1]]),
        height=HEIGHT,
        width=WIDTH,
    )
    on_device = jax.device_put(points)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    cloud.point["colors"] = o3d.core.Tensor(colors.astype(np.float32) / 255)
    intrinsics = o3d.core.Tensor(cameras.intrinsics_px)
    extrinsics = o3d.core.Tensor(invert(pose))

    def theirs() -> object:
        image = cloud.project_to_rgbd_image(
            WIDTH, HEIGHT, intrinsics, extrinsics, depth_scale=1.0, depth_max=100.0
        )
        return image.depth.as_tensor().numpy()

    ours_depth = np.asarray(jitted.splat(on_device, cameras, point_px=1)[0])[0]
    their_depth = theirs()[..., 0]
    both = np.isfinite(ours_depth) & (their_depth > 0)
    assert both.mean() > 0.2, "the images do not overlap"
    assert np.median(np.abs(ours_depth - their_depth)[both]) < 1e-3, "other depths"
    return {
        "NumPy, 1 pixel": lambda: reference.splat(points, cameras, point_px=1),
        "NumPy, 2 pixels": lambda: reference.splat(points, cameras, point_px=2),
        "JAX, 1 pixel": lambda: jax.block_until_ready(jitted.splat(on_device, cameras, point_px=1)),
        "JAX, 2 pixels": lambda: jax.block_until_ready(
            jitted.splat(on_device, cameras, point_px=2)
        ),
        "Open3D, 1 pixel": theirs,
    }


if __name__ == "__main__":
    tyro.cli(main)
