"""Points of a state on the page; each object is a cloud that can be moved alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import viser
import viser.transforms as tf
from jaxtyping import Float

from egosim_jax.types import SceneState

POINT_M = 0.0022
"""Size of a point in meters."""


class StateCloud:
    """Clouds of the background and of the objects of one state."""

    def __init__(self, scene: viser.SceneApi):
        self._scene = scene
        self._clouds: dict[int, viser.PointCloudHandle] = {}
        self._state: SceneState | None = None

    def show(self, state: SceneState) -> None:
        """Show a state in place of the one before."""
        numbers = np.unique(state.object_ids).tolist()
        for number in self._clouds.keys() - set(numbers):
            self._clouds.pop(number).remove()
        for number in numbers:
            points = state.object_ids == number
            self._clouds[number] = self._scene.add_point_cloud(
                f"/state/{number}",
                state.points_m[points],
                state.colors[points],
                point_size=POINT_M,
                point_shading="flat",
            )
        self._state = state

    def move(self, state: SceneState, poses: Mapping[int, Float[np.ndarray, "4 4"]]) -> None:
        """Show the motion of objects since a state, and the others at rest, if it is shown."""
        if state is not self._state:
            return
        for number, cloud in self._clouds.items():
            pose = poses.get(number, np.eye(4))
            position, wxyz = pose[:3, 3], tf.SO3.from_matrix(pose[:3, :3]).wxyz
            if not (np.allclose(cloud.position, position) and np.allclose(cloud.wxyz, wxyz)):
                cloud.position, cloud.wxyz = position, wxyz
