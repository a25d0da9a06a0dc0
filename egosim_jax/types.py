"""What flows between the parts of the simulator, and the glossary of shapes.

Shapes are channel-last everywhere:

    b batch    f frames (pixel frames of a video, or latent frames of its latents)
    h w        rows and columns (pixels, or latent cells of 8 x 8 pixels)
    c          channels: 3 for RGB, 16 for latents, 52 for the denoiser's input
    n d        tokens and their width

Videos on disk and in `Triplet` are uint8 RGB; models see RGB in [-1, 1]. A video of F = 4k+1
frames has k+1 latent frames: the first latent frame encodes one frame, the others four each.
Masks say 1 (or 255) where nothing was observed, so that it must be generated, and 0 where the
prior is to be kept.

This module knows no jax: any generator, in JAX or not, can speak these types.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, UInt8

TEMPORAL_STRIDE = 4
"""Pixel frames per latent frame, after the first."""
SPATIAL_STRIDE = 8
"""Pixels per latent cell, along each axis."""


class InputError(ValueError):
    """Bad usage or bad input: says what happened, the rule, the value and the fix. Exit code 2."""


def check_frame_count(frames: int, *, what: str = "a video", fix: str = "--num-frames") -> None:
    """Raise `InputError` unless `frames` is 4k+1, the lengths the causal video VAE can encode."""
    if frames < 1 or frames % TEMPORAL_STRIDE != 1:
        below = max(1, (frames - 1) // TEMPORAL_STRIDE * TEMPORAL_STRIDE + 1)
        raise InputError(
            f"{what} of {frames} frames cannot be encoded: the video VAE needs 4k+1 frames. "
            f"Nearest: {below} or {below + TEMPORAL_STRIDE}. ({fix})"
        )


def check_counts(counts: Mapping[str, int | None]) -> None:
    """Raise `InputError` at the first count below 1; by name, None if none was given."""
    for name, count in counts.items():
        if count is not None and count < 1:
            raise InputError(f"{name} must be at least 1, not {count}.")


@dataclass(frozen=True, kw_only=True)
class VideoSpec:
    """Length, size and rate of the videos that a model reads and writes."""

    frames: int = 61
    """Pixel frames, 4k+1."""
    height: int = 480
    """Rows in pixels, a multiple of 16 (VAE stride 8 x patch size 2)."""
    width: int = 832
    """Columns in pixels, a multiple of 16."""
    fps: int = 16
    """Frames per second."""

    def __post_init__(self) -> None:
        """Check 4k+1 frames and sizes in multiples of 16."""
        check_frame_count(self.frames)
        for name in ("height", "width"):
            size = getattr(self, name)
            if size < 16 or size % 16:
                raise InputError(
                    f"{name} {size} does not fit the model: it must be a multiple of 16 (8 pixels "
                    f"a latent cell, 2 cells a token). Nearest: {max(16, round(size / 16) * 16)}."
                )
        check_counts({"fps": self.fps})

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Frames, rows and columns of the latents: ((f-1)/4+1, h/8, w/8)."""
        return (
            (self.frames - 1) // TEMPORAL_STRIDE + 1,
            self.height // SPATIAL_STRIDE,
            self.width // SPATIAL_STRIDE,
        )


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Cameras:
    """A camera's path: where it is at each frame, in OpenCV axes (x right, y down, z forward)."""

    world_from_camera: Float[np.ndarray, "f 4 4"]
    """Rigid, in metres."""
    intrinsics_px: Float[np.ndarray, "3 3"]
    """Focal lengths and principal point, with pixel centres at integer coordinates."""
    height: int
    """Rows of a picture."""
    width: int
    """Columns of a picture."""

    def __post_init__(self) -> None:
        """Check that every pose is a rigid motion and that the camera has a picture."""
        rotations = self.world_from_camera[:, :3, :3]
        drift = np.abs(rotations @ rotations.swapaxes(-1, -2) - np.eye(3)).max(axis=(1, 2))
        rigid = np.isfinite(self.world_from_camera).all(axis=(1, 2)) & (drift < 1e-3)
        rigid &= np.linalg.det(np.where(rigid[:, None, None], rotations, np.eye(3))) > 0
        if not rigid.all():
            frame = int(np.argmin(rigid))
            raise InputError(
                f"The camera of frame {frame} is no rigid motion: its matrix must be finite, "
                f"with a rotation of determinant 1, and is\n{self.world_from_camera[frame]}"
            )
        focal = self.intrinsics_px[0, 0], self.intrinsics_px[1, 1]
        if not (np.isfinite(self.intrinsics_px).all() and min(*focal, self.height, self.width) > 0):
            raise InputError(
                f"A camera with intrinsics\n{self.intrinsics_px}\nand {self.width}x{self.height} "
                "pixels has no picture: all must be finite, focal lengths and sizes positive."
            )


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Triplet:
    """One clip's conditions, already at the model's length and size, and the truth if known."""

    video_id: str
    prompt: str
    prior: UInt8[np.ndarray, "f h w 3"]
    """The scene rendered along the camera path, without hands."""
    mask: UInt8[np.ndarray, "f h w"]
    """Where the render shows nothing: 255 not observed, 0 observed, grey where it was resized."""
    hands: UInt8[np.ndarray, "f h w 3"]
    """The hand skeletons on black."""
    first_frame: UInt8[np.ndarray, "h w 3"]
    """The image for CLIP: the scene at the first frame."""
    truth: UInt8[np.ndarray, "f h w 3"] | None = None
    """The video that was really recorded."""
    extra: Mapping[str, str] = field(default_factory=dict)
    """Further metadata columns, carried to the results."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Condition:
    """What the denoiser is told, for a batch; the same at every step. Latents are normalised."""

    mask: Float[Any, "b f h w 4"]
    """1 = generate, 0 = keep; the four channels are a 2 x 2 block of the mask (space to depth)."""
    prior: Float[Any, "b f h w 16"]
    """Latents of the rendered scene, not yet masked."""
    hands: Float[Any, "b f h w 16"]
    """Latents of the hand skeletons."""
    text: Float[Any, "b n d"]
    """Prompt embeddings, zero after the prompt's end."""
    image: Float[Any, "b m e"] | None = None
    """CLIP tokens of the first frame; None for models without the image branch."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Clip:
    """A generated video."""

    frames: UInt8[np.ndarray, "f h w 3"]
    fps: int
