"""The latent grid of a video, and the lengths and sizes that have one."""

from __future__ import annotations

from dataclasses import dataclass

from egosim_jax.types import InputError, VideoSpec


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
        """Raise `InputError` unless the codec can encode so many frames, 4k+1 for a stride of 4."""
        stride = self.temporal_stride
        if frames < 1 or (frames - 1) % stride:
            below = max(1, (frames - 1) // stride * stride + 1)
            raise InputError(
                f"{what} of {frames} frames cannot be encoded: the video VAE needs {stride}k+1 "
                f"frames. Nearest: {below} or {below + stride}. ({fix})"
            )

    def check_size(self, size: int, *, name: str) -> None:
        """Raise `InputError` unless a number of rows or columns is a multiple of a token's."""
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
