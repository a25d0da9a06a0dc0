"""`egosim view`: look at a scene, or at what a simulation recorded."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from egosim_jax.command import DONE
from egosim_jax.io.atomic import atomic_write
from egosim_jax.types import InputError

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.types import SceneState

RECORDING = "simulation.rrd"
Up = Literal["z", "-y"]
SIDES, ABOVE = (-40.0, 0.0, 40.0), 30.0
"""Degrees from which a scene is drawn."""
AWAY, FIELD_OF_VIEW = 3.0, 50.0
"""Distance of the camera, in radii within which three quarters of the points lie; degrees seen."""
HEIGHT, WIDTH = 480, 640


@dataclass(frozen=True, kw_only=True)
class View:
    """Draw a state or a point cloud from three sides, or open a simulation in the Rerun viewer.

    PATH is the folder of a simulation or its simulation.rrd (needs the extra `viewer`), a folder
    that holds a state, such as OUT/clip_1/state, or a PLY of colored points, such as EgoSim's.
    """

    path: Annotated[Path, tyro.conf.Positional]
    """What to look at."""
    out: Path | None = None
    """Picture to write; NAME.png here if not given."""
    up: Up | None = None
    """Which axis of the world points up. If not given: z in the tabletop world; -y elsewhere, as in
    the coordinates of EgoSim's first camera."""

    host: str = "127.0.0.1"
    """Address that the Rerun viewer listens on; others can reach it only if one is named here."""

    def run(self) -> int:
        """Draw, or open the viewer."""
        recording = self.path / RECORDING if self.path.is_dir() else self.path
        if recording.suffix == ".rrd" and recording.exists():
            return _open(recording, self.host)
        if self.path.is_dir() and (self.path / "report.json").exists():
            raise InputError(
                f"{self.path} has no {RECORDING}: it was simulated without Rerun. Install it (pip "
                "install 'egosim-jax[viewer]') and run the same egosim simulate again, which adds "
                f"it; or look at one state: {self.path / 'clip_1' / 'state'}."
            )
        state = self._state()
        up: Up = self.up or ("z" if state.provenance.get("world") == "tabletop" else "-y")
        out = self.out or Path(f"{self.path.stem}.png")
        write_portrait(out, state, up=up)
        low, high = state.points_m.min(axis=0), state.points_m.max(axis=0)
        size = " x ".join(f"{length:.2f}" for length in high - low)
        things = ", ".join(state.names.values()) or "no named things"
        print(f"{len(state.points_m)} points, {size} m, {things}")
        print(out)
        return DONE

    def _state(self) -> SceneState:
        from egosim_jax.state.snapshot import load, read_ply

        if self.path.is_dir():
            return load(self.path)
        if self.path.suffix == ".ply":
            return read_ply(self.path)
        raise InputError(
            f"{self.path} cannot be looked at: give the folder of a simulation or of a state, a "
            ".rrd or a .ply."
        )


def _open(recording: Path, host: str) -> int:
    if find_spec("rerun") is None:
        raise InputError(
            f"{recording} is opened by Rerun, which is not installed: "
            "pip install 'egosim-jax[viewer]'."
        )
    command = [sys.executable, "-m", "rerun", "--bind", host, str(recording)]
    return subprocess.run(command, check=False).returncode  # noqa: S603


def write_portrait(path: Path, state: SceneState, *, up: Up) -> None:
    """Draw a state from the left, the front and the right, beside each other."""
    import numpy as np
    from PIL import Image

    with atomic_write(path) as temporary:
        Image.fromarray(np.concatenate(list(portrait(state, up=up)), axis=1)).save(temporary)


def portrait(state: SceneState, *, up: Up) -> np.ndarray:
    """Pictures `3 480 640 3` from the left, the front and the right, a little from above.

    The front is where a wearer looks from: along y if z is up, along z if -y is. Points are drawn
    as large as they lie apart.
    """
    import numpy as np
    import open3d as o3d

    from egosim_jax.geometry import look_at
    from egosim_jax.rendering.reference import render
    from egosim_jax.types import Cameras

    upward, forward = {"z": ((0, 0, 1), (0, 1, 0)), "-y": ((0, -1, 0), (0, 0, 1))}[up]
    upward, forward = np.array(upward, float), np.array(forward, float)
    rightward = np.cross(forward, upward)
    middle = np.median(state.points_m, axis=0).astype(float)
    radius = float(np.quantile(np.linalg.norm(state.points_m - middle, axis=1), 0.75))
    away = AWAY * max(radius, 1e-6)
    poses = []
    for side in np.radians(SIDES):
        level = np.cos(side) * forward - np.sin(side) * rightward
        above = np.radians(ABOVE)
        eye = middle + away * (np.sin(above) * upward - np.cos(above) * level)
        poses.append(look_at(eye, middle, up=upward))
    focal = WIDTH / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(state.points_m))
    apart = float(np.median(cloud.compute_nearest_neighbor_distance()))
    cameras = Cameras(
        world_from_camera=np.array(poses),
        intrinsics_px=np.array(
            [[focal, 0, (WIDTH - 1) / 2], [0, focal, (HEIGHT - 1) / 2], [0, 0, 1]]
        ),
        height=HEIGHT,
        width=WIDTH,
    )
    return render(state, cameras, point_px=1 + round(2 * focal * apart / away)).frames
