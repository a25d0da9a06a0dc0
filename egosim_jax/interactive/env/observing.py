"""Further cameras of an episode: their clips, first frames and depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import Backend
from egosim_jax.simulation.rig import MountedCamera, Rig, check_cameras
from egosim_jax.simulation.simulator import Simulator, Step
from egosim_jax.simulation.start import Start
from egosim_jax.simulation.views import view_from
from egosim_jax.types import Cameras, InputError, SceneState, View


def unobserved_info(step: Step) -> dict[str, Any]:
    """Return the share of pixels that the state does not show, by camera, as of `info`."""
    shares = {name: seen.unobserved for name, seen in step.others.items()}
    return {"unobserved": shares} if shares else {}


@dataclass(frozen=True, kw_only=True)
class Observer:
    """Further cameras in the episodes of a world."""

    backend: Backend
    """World of the episodes."""
    actions: ActionSpec
    """Hands that may carry cameras."""
    cameras: tuple[MountedCamera, ...] = ()
    """The cameras."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless the cameras fit together and the hands."""
        check_cameras(self.cameras, self.actions.sides)

    def on(self, simulator: Simulator, rows: Float[np.ndarray, "k d"]) -> Simulator:
        """Return a simulator that makes the clip of some rows for all cameras."""
        return replace(simulator, rig=self._rig(rows)) if self.cameras else simulator

    def paths(self, main: Cameras, rows: Float[np.ndarray, "k d"]) -> dict[str, Cameras]:
        """Return each camera in the frames of the main camera, by name."""
        return self._rig(rows).paths(main)

    def _rig(self, rows: Float[np.ndarray, "k d"]) -> Rig:
        sides = self.actions.sides
        return Rig(cameras=self.cameras, sides=sides, wrists=self.actions.wrists(rows))

    def first_frames(self, start: Start) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
        """Return the first frame of each camera after a start, by name.

        Raises `InputError` if a camera on the head or in the world sees no point of the state.
        """
        if not self.cameras:
            return {}
        frames = {}
        row = self.actions.rest if start.row is None else start.row
        main = self.actions.cameras_of(row[None], start.camera)
        paths = self.paths(main, row[None])
        for camera in self.cameras:
            path = paths[camera.name]
            view = self._view(start, start.state, path)
            if camera.side is None and not np.isfinite(view.depth_m).any():
                raise InputError(
                    f"Camera {camera.name} sees none of the {len(start.state.points_m)} points of "
                    f"the state: its pose must be {camera.mount}_from_camera in meters, with the "
                    "camera's x to the right, y down and z forward. (cameras)"
                )
            frames[camera.name] = self.backend.first_frame(start, path, view, self.actions.kind)
        return frames

    def depth(
        self, name: str, start: Start, state: SceneState, main: Cameras, row: np.ndarray
    ) -> Float32[np.ndarray, "h w"]:
        """Return the depth of a state from a camera, in meters; infinite where it is empty."""
        path = self.paths(main, row[None])[name]
        return np.asarray(self._view(start, state, path).depth_m[0])

    def _view(self, start: Start, state: SceneState, path: Cameras) -> View:
        simulator = self.backend.simulator(start)
        return view_from(simulator.renderer, state, path, point_px=simulator.point_px)
