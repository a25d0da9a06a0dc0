"""Depth and cameras from files of another program, such as EgoSim's data preparation.

    depth_000000.npy ...        `h w`, depth along the z axis; 0, NaN or infinity where unknown
    intrinsics_000000.npy ...   `3 3`, in pixels of the depth map
    extrinsics_000000.npy ...   `3 4` or `4 4`, camera from world, in OpenCV axes

Maps may be smaller than the video; they are resized to it together with their intrinsics. Source:
the released `data_process` of EgoSim, which runs Depth Anything 3; see also the latter's export.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from egosim_jax.geometry import invert
from egosim_jax.io.bounded import quote_path, quote_text, read_bytes
from egosim_jax.io.untrusted.npz import read_npy
from egosim_jax.perception.estimates import CameraEstimate, DepthEstimate, Verdict
from egosim_jax.types import Cameras, InputError

MAX_VALUES = 1 << 25
"""Maximum number of values in an array file."""


@dataclass(frozen=True)
class DepthFiles:
    """Depth maps from files of another program; a `DepthEstimator`."""

    folder: Path
    """Folder of depth_######.npy, and intrinsics_ and extrinsics_ if there are cameras."""
    metric: bool = True
    """True if the files are in meters."""

    def __call__(
        self,
        frames: UInt8[np.ndarray, "f h w 3"],
        moving: Bool[np.ndarray, "f h w"],
        estimate: CameraEstimate,
        wanted: Sequence[int],
    ) -> DepthEstimate:
        """Return the depth maps of the wanted frames at the size of the video."""
        height, width = frames.shape[1:3]
        depth = np.stack([self._depth(frame, height, width) for frame in wanted])
        return DepthEstimate.measured(wanted, depth, metric=self.metric)

    def cameras(self, count: int, *, height: int, width: int) -> CameraEstimate:
        """Return the cameras of the first `count` frames, for a video of the given size.

        The intrinsics are the mean over all frames. Raises `InputError` if a file is missing, and
        if a pose is not a rigid transform.
        """
        poses, matrices = [], []
        for frame in range(count):
            matrix = self._read("intrinsics", frame)
            pose = self._read("extrinsics", frame)
            if matrix.shape != (3, 3) or pose.shape not in ((3, 4), (4, 4)):
                raise InputError(
                    f"{quote_path(self.folder)}: cameras of frame {frame} have the shapes "
                    f"{matrix.shape} and {pose.shape}: they must be (3, 3), and (3, 4) or (4, 4)."
                )
            size = self._read("depth", frame).shape
            matrices.append(_resize_intrinsics(matrix, size, (height, width)))
            poses.append(np.concatenate([pose[:3], [[0, 0, 0, 1]]]))
        cameras = Cameras(
            world_from_camera=invert(np.array(poses)),
            intrinsics_px=np.mean(matrices, axis=0),
            height=height,
            width=width,
        )
        verdict = Verdict(rung="given", reason=f"read from {self.folder.name}", figures={})
        return CameraEstimate(cameras=cameras, metric=self.metric, verdict=verdict)

    def _depth(self, frame: int, height: int, width: int) -> Float32[np.ndarray, "h w"]:
        import cv2

        depth = self._read("depth", frame)
        if depth.ndim != 2:
            raise InputError(
                f"{quote_path(self._path('depth', frame))} has shape {depth.shape}: it must be "
                "(height, width)."
            )
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.inf).astype(np.float32)
        if depth.shape == (height, width):
            return depth
        return cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)

    def _read(self, kind: str, frame: int) -> np.ndarray:
        path = self._path(kind, frame)
        try:
            values = read_npy(read_bytes(path, limit=9 * MAX_VALUES), "it")
            if values.dtype == bool or not 0 < values.size <= MAX_VALUES:
                raise ValueError(f"it holds {values.dtype} {values.shape}")
            return values.astype(float)
        except InputError:
            raise
        except (ValueError, EOFError) as error:
            why = quote_text(str(error))
            raise InputError(f"{quote_path(path)} is not an array of numbers: {why}.") from error

    def _path(self, kind: str, frame: int) -> Path:
        return self.folder / f"{kind}_{frame:06d}.npy"


def _resize_intrinsics(
    matrix: Float[np.ndarray, "3 3"], size: tuple[int, ...], target: tuple[int, int]
) -> Float[np.ndarray, "3 3"]:
    """Return intrinsics for another image size, with pixel centers at integer coordinates."""
    scale = np.array([target[1] / size[1], target[0] / size[0]])
    resized = matrix.copy()
    resized[:2] *= scale[:, None]
    resized[:2, 2] += (scale - 1) / 2
    return resized
