"""Space of the observations of an episode."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.types import VideoSpec

STATE_POINTS = 2048
"""Number of points in the observation `state`."""
FAR_M = 100.0
"""Depth of empty pixels and bound of observed positions, in meters."""


def observation_space(video: VideoSpec, spec: ActionSpec, observe: tuple[str, ...]) -> spaces.Dict:
    """Return the space of the row and the requested observations, also of further cameras."""
    size = (video.height, video.width)
    low, high = spec.bounds
    keypoints = (len(spec.sides), 21 if spec.kind == "human" else 3, 3)
    by_name = {
        "frames": spaces.Box(0, 255, (video.frames, *size, 3), np.uint8),
        "depth": spaces.Box(0, FAR_M, size, np.float32),
        "keypoints": spaces.Box(-FAR_M, FAR_M, keypoints, np.float64),
        "state": spaces.Dict(
            {
                "points_m": spaces.Box(-FAR_M, FAR_M, (STATE_POINTS, 3), np.float32),
                "colors": spaces.Box(0, 255, (STATE_POINTS, 3), np.uint8),
                "object_ids": spaces.Box(-(2**31), 2**31 - 1, (STATE_POINTS,), np.int32),
            }
        ),
    }
    row = spaces.Box(low, high, dtype=np.float64)
    return spaces.Dict({"row": row, **{name: by_name[name.split(".")[-1]] for name in observe}})
