"""Errors of input, and settings of every layer: video sizes, their latent grid, the mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np


class InputError(ValueError):
    """Bad usage or bad input: says what happened, the rule, the value and the fix. Exit code 2."""


def check_video(what: str, frames: np.ndarray, shape: tuple[int, int, int] | None = None) -> None:
    """Raise `InputError` unless `frames` is a uint8 RGB video `f h w 3`, of a size if given."""
    have = np.shape(frames)
    fits = len(have) == 4 and have[3] == 3 and 0 not in have and shape in (None, have[:3])
    if not fits or getattr(frames, "dtype", None) != np.uint8:
        size = "(frames, height, width" if shape is None else str(shape)[:-1]
        raise InputError(
            f"{what} is {getattr(frames, 'dtype', type(frames).__name__)} {have}: it must be uint8 "
            f"{size}, 3)."
        )


def check_seed(seed: int, *, name: str = "--seed") -> None:
    """Raise `InputError` unless a seed is a whole number from 0 to 2**63 - 1."""
    if not (hasattr(seed, "__index__") and 0 <= seed < 2**63):
        raise InputError(f"{name} must be a whole number from 0 to 2**63 - 1, not {seed!r:.40}.")


def check_counts(counts: Mapping[str, int | None]) -> None:
    """Raise `InputError` at the first count below 1; counts are by name, None if not given."""
    for name, count in counts.items():
        if count is not None and count < 1:
            raise InputError(f"{name} must be at least 1, not {count}.")


@dataclass(frozen=True, kw_only=True)
class Counted:
    """Settings whose whole numbers are all at least 1."""

    def __post_init__(self) -> None:
        """Raise `InputError` at the first whole number below 1."""
        check_counts(
            {f.name: getattr(self, f.name) for f in fields(self) if f.type in ("int", int)}
        )


@dataclass(frozen=True, kw_only=True)
class VideoSpec(Counted):
    """Length, size and rate of the videos that a model reads and writes."""

    frames: int = 61
    """Pixel frames of a video."""
    height: int = 480
    """Rows of a frame in pixels."""
    width: int = 832
    """Columns of a frame in pixels."""
    fps: int = 16
    """Frame rate of the video in frames per second."""


@dataclass(frozen=True, kw_only=True)
class VideoGrid:
    """Latent grid of a video: the strides of the codec and the patch of the denoiser."""

    temporal_stride: int
    """Pixel frames per latent frame, after the first."""
    spatial_stride: int
    """Pixels per latent cell, along each axis."""
    patch: int
    """Latent cells per token, along each axis."""

    def check_frames(
        self, frames: int, *, what: str = "a video", fix: str = "--num-frames"
    ) -> None:
        """Raise `InputError` unless the codec can encode `frames`: 4k+1 for a stride of 4."""
        stride = self.temporal_stride
        if frames < 1 or (frames - 1) % stride:
            below = max(1, (frames - 1) // stride * stride + 1)
            raise InputError(
                f"{what} of {frames} frames cannot be encoded: the video VAE needs {stride}k+1 "
                f"frames. Nearest: {below} or {below + stride}. ({fix})"
            )

    def check_size(self, size: int, *, name: str) -> None:
        """Raise `InputError` unless a number of rows or columns divides into tokens."""
        unit = self.spatial_stride * self.patch
        if size < unit or size % unit:
            raise InputError(
                f"{name} {size} does not fit the model: it must be a multiple of {unit} "
                f"({self.spatial_stride} pixels a latent cell, {self.patch} cells a token). "
                f"Nearest: {max(unit, round(size / unit) * unit)}."
            )

    def check(self, video: VideoSpec) -> None:
        """Raise `InputError` unless a video has a latent grid."""
        self.check_frames(video.frames)
        self.check_size(video.height, name="height")
        self.check_size(video.width, name="width")

    def latent_shape(self, video: VideoSpec) -> tuple[int, int, int]:
        """Return frames, rows and columns of a video's latents."""
        return (
            (video.frames - 1) // self.temporal_stride + 1,
            video.height // self.spatial_stride,
            video.width // self.spatial_stride,
        )


WAN_GRID = VideoGrid(temporal_stride=4, spatial_stride=8, patch=2)
"""Latent grid of Wan 2.1 and EgoSim, for clips and shards that name no other."""


@dataclass(frozen=True, kw_only=True)
class MeshConfig:
    """Sizes of the mesh axes, whose product is the number of devices.

    One of them may be -1: it takes all remaining devices.
    """

    data: int = 1
    """Copies of the weights, each with its own part of the batch."""
    fsdp: int = -1
    """Devices that share one copy of the weights."""
    context: int = 1
    """Devices that share one sample, each with a part of its tokens."""
