"""Videos and cameras of `look_away` as WRBench's evaluation reads them.

    videos.json                    manifest, a list of one record for each video
    ID.mp4                         all clips of a scene, one after the other
    ID.mp4.target_c2w.npy          camera of each frame: camera to world, OpenCV's axes, in meters
    ID.mp4.camera_trajectory.json  the same with intrinsics
    ID.mp4.camera.json             the control that was asked for: which way, how far, and back

Paths are relative to the folder: run `wrbench eval run --manifest videos.json` in it. The head
turns by 50 degrees, not by WRBench's 60, so its camera scores need
`--sidecar-profile-gate certified_opencv`. Source: JinPLu/WRBench, docs/eval/README.md and
trajectory.py at 629595dc.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.run import write_json
from egosim_jax.io.writing import write_video

CONVENTION = "opencv_c2w"


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Record:
    """A video with its cameras, and what should be seen."""

    name: str
    """Name of the video, unique in the folder."""
    frames: UInt8[np.ndarray, "f h w 3"]
    """All frames."""
    fps: int
    """Frames per second."""
    world_from_camera: Float[np.ndarray, "f 4 4"]
    """Camera of each frame."""
    intrinsics_px: Float[np.ndarray, "3 3"]
    """Intrinsics of the camera."""
    degrees: float
    """Largest turn of the head: positive to the left."""
    about: Mapping[str, Any]
    """Other fields of the manifest, such as the expected state."""

    @property
    def direction(self) -> str:
        """WRBench's name of the motion: first one way, then back."""
        return "yaw_LR" if self.degrees > 0 else "yaw_RL"

    def write(self, folder: Path) -> dict[str, Any]:
        """Write the video and its files; return its record in the manifest."""
        video, count = f"{self.name}.mp4", len(self.frames)
        height, width = self.frames.shape[1:3]
        write_video(folder / video, self.frames, self.fps)
        with (
            atomic_write(folder / f"{video}.target_c2w.npy") as temporary,
            temporary.open("wb") as f,
        ):
            np.save(f, self.world_from_camera.astype(np.float32))
        trajectory = {
            "coordinate_convention": CONVENTION,
            "camera_type": self.direction,
            "fps": self.fps,
            "source": "egosim_jax",
            "conversion_mode": "direct_pose",
            "frame_count": count,
            "c2w": self.world_from_camera.tolist(),
            "intrinsics": [self.intrinsics_px.tolist()] * count,
        }
        write_json(folder / f"{video}.camera_trajectory.json", trajectory)
        peak = abs(self.degrees)
        control = {
            "target_pose_path": f"{video}.target_c2w.npy",
            "camera_trajectory_path": f"{video}.camera_trajectory.json",
            "target_source": "egosim_jax",
            "target_coordinate_convention": CONVENTION,
            "target_role": "benchmark_intended_control",
            "control_family": "rotation",
            "control_direction": self.direction,
            "control_profile": f"diagnostic_{peak:g}deg",
            "evidence_level": "benchmark_intent",
            "adapter_provenance": "exact_model_payload_exported",
            "source_action": self.direction,
            "camera_type": self.direction,
            "yaw_peak_deg": peak,
            "num_frames": count,
            "fps": float(self.fps),
            "image_size": [width, height],
            "fov": float(np.degrees(2 * np.arctan(width / (2 * self.intrinsics_px[0, 0])))),
            "trajectory_sampling_rule": "one pose for each frame",
        }
        write_json(folder / f"{video}.camera.json", control)
        return {
            "video_id": self.name,
            "path": video,
            "video_path": video,
            "camera": self.direction,
            **control,
            **self.about,
        }


def write_manifest(folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Write videos.json, the last file: it names only existing files."""
    write_json(folder / "videos.json", list(records))
