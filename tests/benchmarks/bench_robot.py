"""Robots in place of the hands of the tabletop world: reach, limits, depth order, replay, time.

    python -m tests.benchmarks.bench_robot [--robot NAME] [--scenes N] [--size F H W FPS]
        [--out FOLDER]

For each scene: the share of frames that the robot reaches, its largest distance from the pinch
point, its direction error (median and largest), its distance from the table and between its links,
and its speed relative to the limits; the share of the objects' pixels where the robot is in front
or behind as in the ray-cast scene; the largest distance between the grip in the LeRobot dataset and
the grip that MuJoCo gives for the dataset's joint positions;
the sources of the pixels behind hands; and the seconds of conversion and dataset (clock and CPU),
without the making of the scene. The last line has the peak memory of the process. FOLDER keeps the
datasets, for example for `lerobot-doctor check` and `lelint check`.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from egosim_jax.geometry import pixel_rays
from egosim_jax.robots.arms import arm_of
from egosim_jax.robots.conversion import Conversion, convert, export, report_of
from egosim_jax.robots.drawing import Shape
from egosim_jax.robots.models import grip_of, load_model
from egosim_jax.robots.sources import of_episode
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import Script, make_scripts, make_sequence, to_episode
from egosim_jax.worlds.tabletop.embree import rays_among
from egosim_jax.worlds.tabletop.raycast import RayCaster

FIRST_OBJECT = 10
"""Lowest id of the tabletop world's objects."""
EVERY = 4
"""Distance of the frames whose depth order is compared."""


def depth_order(found: Conversion, script: Script) -> float:
    """Return the share of the objects' pixels that show the nearer of robot and object."""
    (follower,), (action,) = found.followers, found.episode.actions
    cameras, track, shape = action.cameras, follower.placed.track, Shape(robot=follower.robot)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    right = count = 0
    for frame in range(0, len(track.q), EVERY):
        pose = cameras.world_from_camera[frame]
        towards = (rays.reshape(-1, 3) @ pose[:3, :3].T).astype(np.float32)
        eye = np.broadcast_to(pose[:3, 3].astype(np.float32), towards.shape)
        scene = RayCaster(script.moments[frame].scene.placed())
        hits = scene.rays.cast(eye, towards)
        numbers = np.array([*(part.instance_id for part in scene.placed), 0])[hits.meshes]
        meshes = shape.pose(
            track.q[frame], float(track.opening_m[frame]), follower.placed.world_from_base
        )
        nearer = rays_among(meshes).cast(eye, towards).distances < hits.distances
        own = numbers >= FIRST_OBJECT
        right += int((found.drawn[0].mask[frame].ravel() == nearer)[own].sum())
        count += int(own.sum())
    return right / count


def replay_error(found: Conversion, folder: Path) -> float:
    """Return the largest distance in meters between the grips of a dataset and of its joints."""
    mujoco: Any = import_module("mujoco")

    (follower,) = found.followers
    robot, joints = follower.robot, len(follower.robot.arm.joints)
    table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    errors, data = [], mujoco.MjData(robot.mj)
    rows, grips = (np.array(table[f"observation.{n}"].to_pylist()) for n in ("state", "grip"))
    for row, grip in zip(rows, grips, strict=True):
        q = robot.home
        q[robot.joint_at] = row[:joints]
        data.qpos[:] = robot.open(q, row[joints] * robot.largest_m)
        mujoco.mj_kinematics(robot.mj, data)
        errors.append(np.linalg.norm(grip_of(robot, data)[:3, 3] - grip[:3]))
    return float(max(errors))


def main() -> None:
    """Measure the scenes one by one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--size", type=int, nargs=4, default=(17, 96, 160, 8))
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    spec = VideoSpec(**dict(zip(("frames", "height", "width", "fps"), args.size, strict=True)))
    robot = load_model(arm_of(args.robot))
    for seed in range(args.scenes):
        script = next(make_scripts(seed, spec=spec))
        source = of_episode(to_episode([next(make_sequence(seed, spec=spec))], fps=spec.fps))
        began, cpu = time.monotonic(), time.process_time()
        found = convert(source, robot)
        with tempfile.TemporaryDirectory() as name:
            folder = (args.out or Path(name)) / str(seed)
            export(found, folder)
            seconds = time.monotonic() - began, time.process_time() - cpu
            replayed = replay_error(found, folder)
        report = report_of(found)
        (entry,) = report["robots"]
        turn = entry["turn_error_degrees"]
        print(
            f"{seed}: reached {entry['reached']:.1%}, {1e3 * entry['pinch_error_m']['max']:.1f} mm "
            f"off, turned {turn['median']:.1f} and {turn['max']:.1f} degrees, "
            f"table {1e3 * entry['least_distance_from_table_m']:.1f} mm, "
            f"links {1e3 * entry['least_distance_of_links_m']:.1f} mm, speed "
            f"{entry['speed_in_limits']:.2f}, order {depth_order(found, script):.2%}, replay "
            f"{1e3 * replayed:.4f} mm, {report['hand_pixels']}, {seconds[0]:.1f} s, "
            f"{seconds[1]:.1f} s of CPU",
            flush=True,
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory {peak:.0f} MiB")


if __name__ == "__main__":
    main()
