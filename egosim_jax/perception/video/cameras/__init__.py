"""Estimation of the cameras of a recorded video, and undistortion of its frames.

Cameras from networks are in `networks`; alignment with a state is in `state.align`.

    CameraLadder:                 the estimator, a ladder of methods
    GateConfig:                   thresholds for accepting a reconstruction
    ColmapConfig, ColmapError:    structure from motion by COLMAP, and its failure
    undistort, undistort_pixels:  removal of the lens's radial distortion
"""

from egosim_jax.perception.video.cameras.colmap import ColmapConfig, ColmapError
from egosim_jax.perception.video.cameras.gate import GateConfig
from egosim_jax.perception.video.cameras.ladder import CameraLadder
from egosim_jax.perception.video.cameras.lens import undistort, undistort_pixels

__all__ = [
    "CameraLadder",
    "ColmapConfig",
    "ColmapError",
    "GateConfig",
    "undistort",
    "undistort_pixels",
]
