"""Cameras of recorded videos: a ladder of methods, a gate for their results, and lenses."""

from egosim_jax.perception.cameras.colmap import ColmapConfig, ColmapError
from egosim_jax.perception.cameras.gate import GateConfig
from egosim_jax.perception.cameras.ladder import CameraLadder
from egosim_jax.perception.cameras.lens import undistort, undistort_pixels

__all__ = [
    "CameraLadder",
    "ColmapConfig",
    "ColmapError",
    "GateConfig",
    "undistort",
    "undistort_pixels",
]
