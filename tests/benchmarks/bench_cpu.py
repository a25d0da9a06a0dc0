"""Splatting, fusing and loading on a CPU, versus Open3D and torch.

    python -m tests.benchmarks.bench_cpu [--rounds 9]

Three pairs of programs; the two of a pair take turns, so that a busy machine slows both:

    splat    a million points at 832x480: ours in JAX, and Open3D's `project_to_rgbd_image`
    fuse     17 frames of 832x480 with voxels of 3 mm: ours, and plain Open3D
    load     random latents of 273 kB in batches of 8: ours, and torch's `DataLoader`, both
             without worker processes

Prints the median of each and the median of the rounds' ratios, ours to theirs.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np
import open3d as o3d
from torch.utils.data import DataLoader, RandomSampler

from egosim_jax import configs
from egosim_jax.data.loader import make_loader
from egosim_jax.data.records import stacked
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.geometry import invert, look_at
from egosim_jax.rendering import jitted
from egosim_jax.state.tsdf import BLOCK_VOXELS, Fusion, surface
from egosim_jax.types import Cameras, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence
from egosim_jax.worlds.tabletop.scene import FIRST_HAND

SPEC = VideoSpec(frames=17, height=480, width=832, fps=16)
RECORDS, BATCH, BATCHES = 256, 8, 150


def main() -> None:
    """Print a line for each pair."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        for name, pair in (("splat", splat), ("fuse", fuse), ("load", lambda: load(Path(folder)))):
            ours, theirs = pair()
            times = [(_ms(ours), _ms(theirs)) for _ in range(1 + options.rounds)][1:]
            one, other = (median(column) for column in zip(*times, strict=True))
            ratio = median(a / b for a, b in times)
            print(f"{name}: ours {one:.1f} ms, theirs {other:.1f} ms, ratio {ratio:.2f}")


def _ms(program: Callable[[], object]) -> float:
    begun = time.perf_counter()
    program()
    return 1000 * (time.perf_counter() - begun)


def splat() -> tuple[Callable[[], object], Callable[[], object]]:
    """Draw points of one pixel."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, 0, 0], [1, 1, 0.4], (1_000_000, 3)).astype(np.float32)
    up = np.array([0.0, 0.0, 1.0])
    cameras = Cameras(
        world_from_camera=look_at(np.array([0, -0.4, 0.7]), np.array([0, 0.5, 0.1]), up=up)[None],
        intrinsics_px=np.array([[600.0, 0, 415.5], [0, 600.0, 239.5], [0, 0, 1]]),
        height=SPEC.height,
        width=SPEC.width,
    )
    on_device = jax.device_put(points)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    cloud.point["colors"] = o3d.core.Tensor(np.zeros_like(points))
    to_camera = o3d.core.Tensor(invert(cameras.world_from_camera[0]))
    pixels = SPEC.width, SPEC.height, o3d.core.Tensor(cameras.intrinsics_px), to_camera
    return (
        lambda: jax.block_until_ready(jitted.splat(on_device, cameras, point_px=1)),
        lambda: cloud.project_to_rgbd_image(*pixels, depth_scale=1.0, depth_max=100.0),
    )


def fuse() -> tuple[Callable[[], object], Callable[[], object]]:
    """Fuse the resting surfaces of a clip; plain Open3D chooses its blocks itself."""
    clip = next(make_sequence(0, spec=SPEC))
    still = (clip.ids > 0) & (clip.ids < FIRST_HAND) & (clip.ids != clip.body_ids[clip.target])
    depth_m, fusion = np.where(still, clip.depth_m, 0).astype(np.float32), Fusion()
    cameras, float32 = clip.cameras, o3d.core.float32
    intrinsics = o3d.core.Tensor(cameras.intrinsics_px)
    far, reach = fusion.max_depth_m, fusion.truncation_m / fusion.voxel_m

    def plain() -> object:
        grid = o3d.t.geometry.VoxelBlockGrid(
            *(("tsdf", "weight", "color"), (float32,) * 3, (1, 1, 3)),
            voxel_size=fusion.voxel_m,
            block_resolution=BLOCK_VOXELS,
            block_count=10_000,
        )
        for depth, colors, pose in zip(
            depth_m, clip.frames, cameras.world_from_camera, strict=True
        ):
            image = o3d.t.geometry.Image(o3d.core.Tensor(depth))
            color = o3d.t.geometry.Image(o3d.core.Tensor(colors.astype(np.float32)))
            seen = intrinsics, o3d.core.Tensor(invert(pose)), 1.0, far, reach
            blocks = grid.compute_unique_block_coordinates(image, *seen)
            grid.integrate(blocks, image, color, intrinsics, *seen)
        return grid.extract_point_cloud(weight_threshold=fusion.observations)

    return (lambda: surface(depth_m, clip.frames, cameras, fusion=fusion)), plain


def load(folder: Path) -> tuple[Callable[[], object], Callable[[], object]]:
    """Read batches of latents of `tabletop`, after those that were read ahead."""
    config, rng = configs.get("tabletop"), np.random.default_rng(0)
    size = config.image.image_size
    with ShardWriter(folder / "latents", kind="latents", spec=config.video) as writer:
        for number in range(RECORDS):
            shape = (*config.latent_shape, config.vae.latent_channels)
            names = ("target", "prior", "hands")
            arrays = {name: rng.standard_normal(shape, np.float32) for name in names}
            arrays["pixels"] = rng.standard_normal((size, size, 3), np.float32)
            writer.add(arrays, {"video_id": str(number), "prompt": "", "extra": {}})
    source = ShardReader(folder / "latents")

    class Records:
        """The same records for torch."""

        def __len__(self) -> int:
            return len(source)

        def __getitem__(self, index: int) -> Any:
            return source[index].arrays

    ours = make_loader(source, batch_size=BATCH, seed=0)
    sampler = RandomSampler(Records(), replacement=True, num_samples=2**40)
    theirs = iter(DataLoader(Records(), BATCH, sampler=sampler, collate_fn=stacked))
    return (lambda: [next(ours) for _ in range(BATCHES)]), (
        lambda: [next(theirs) for _ in range(BATCHES)]
    )


if __name__ == "__main__":
    main()
