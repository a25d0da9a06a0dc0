"""Rerun recordings of simulations: scene, cameras, hands and videos over time.

Entities, in meters and world coordinates: `world/state`, the points before each clip and at the
end; `action`, the prompts;
`world/hands/N`, the skeletons; `world/camera`, with the generated frame in its frustum; and the
videos `view` and `ground_truth`. The timeline `frame` counts through all clips.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from egosim_jax.io.atomic import atomic_write
from egosim_jax.rendering.skeleton import SKELETONS

if TYPE_CHECKING:
    from egosim_jax.types import Action, SceneState

RECORDING = "simulation.rrd"
"""File name of a recording in the folder of a simulation."""
POINT_M, BONE_M = 0.0015, 0.004
"""Radius of points and of bones in meters."""
JPEG_QUALITY = 85
"""Quality of the recorded frames."""


class Recording:
    """Rerun recording in progress; its file is complete once it is closed."""

    def __init__(self, path: Path, name: str, *, up: Float[np.ndarray, " 3"]):
        """Begin a recording of a world, whose axis nearest to `up` points up in the viewer."""
        import rerun as rr
        import rerun.blueprint as rrb

        self._writing = atomic_write(path)
        self._rr, self._frame = rr, 0
        self._stream = rr.RecordingStream("egosim", recording_id=name)
        self._stream.save(self._writing.__enter__())
        images = (
            ("view", "/view"),
            ("generated", "/world/camera"),
            ("ground truth", "/ground_truth"),
        )
        column = rrb.Vertical(*(rrb.Spatial2DView(name=n, origin=o) for n, o in images))
        scene = rrb.Spatial3DView(name="world", origin="/world")
        self._stream.send_blueprint(rrb.Blueprint(rrb.Horizontal(scene, column)))
        axis = int(np.abs(up).argmax())
        world = f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}"
        self._stream.log("world", getattr(rr.ViewCoordinates, world), static=True)

    def add(
        self,
        state: SceneState,
        action: Action,
        *,
        view: np.ndarray,
        frames: np.ndarray,
        ground_truth: np.ndarray | None,
    ) -> None:
        """Record a clip: the state before it, the action, and its videos `f h w 3`."""
        rr, log = self._rr, self._stream.log
        bones = SKELETONS[action.kind].bones
        cameras = action.cameras
        for frame, pose in enumerate(cameras.world_from_camera):
            self._stream.set_time("frame", sequence=self._frame)
            if frame == 0:
                self._points(state)
                log("action", rr.TextLog(action.prompt))
            log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            log(
                "world/camera",
                rr.Pinhole(
                    image_from_camera=cameras.intrinsics_px,
                    width=cameras.width,
                    height=cameras.height,
                    image_plane_distance=0.15,
                ),
            )
            log("world/camera", self._image(frames[frame]))
            log("view", self._image(view[frame]))
            if ground_truth is not None:
                log("ground_truth", self._image(ground_truth[frame]))
            for number, joints in enumerate(action.joints_m[frame]):
                log(f"world/hands/{number}", rr.LineStrips3D(joints[bones], radii=BONE_M))
            self._frame += 1

    def close(self, state: SceneState) -> None:
        """Record the last state and move the file to its path."""
        self._stream.set_time("frame", sequence=self._frame)
        self._points(state)
        self._stream.flush()
        self._stream.disconnect()
        self._writing.__exit__(None, None, None)

    def _points(self, state: SceneState) -> None:
        points = self._rr.Points3D(state.points_m, colors=state.colors, radii=POINT_M)
        self._stream.log("world/state", points)

    def _image(self, frame: np.ndarray) -> Any:
        return self._rr.Image(frame).compress(jpeg_quality=JPEG_QUALITY)
