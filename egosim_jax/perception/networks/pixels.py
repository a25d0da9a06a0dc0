"""Preprocessing of frames without torchvision, which some networks' image processors need.

All functions run in a worker. Sizes and statistics come from the checkpoint's processor files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egosim_jax.io.bounded import quote, quote_path, read_json
from egosim_jax.types import InputError

if TYPE_CHECKING:
    import torch

MAX_SIZE = 4096
"""Maximum side of a network's input in pixels."""


@dataclass(frozen=True, kw_only=True)
class PixelSettings:
    """Size and statistics of a network's input images."""

    height: int
    width: int
    mean: tuple[float, ...]
    std: tuple[float, ...]

    @classmethod
    def read(cls, folder: Path, default: PixelSettings) -> PixelSettings:
        """Return the settings in a checkpoint's processor files, with defaults for missing ones.

        video_preprocessor_config.json overrides preprocessor_config.json, which overrides
        processor_config.json.
        """
        settings: dict[str, Any] = {}
        for name in ("processor_config", "preprocessor_config", "video_preprocessor_config"):
            path = folder / f"{name}.json"
            if path.is_file():
                content = read_json(path)
                for key in ("image_processor", "video_processor"):
                    settings |= content.get(key) or {}
                settings |= content
        size = settings.get("size") or {"height": default.height, "width": default.width}
        values = tuple(size.get(side) or 0 for side in ("height", "width"))
        if not all(isinstance(v, int) and 0 < v <= MAX_SIZE for v in values):
            raise InputError(
                f"{quote_path(folder)}: size {quote(str(size))} of its image processor is not a "
                f"height and a width of at most {MAX_SIZE} pixels. Download its files again."
            )
        mean, std = (settings.get(f"image_{n}") or getattr(default, n) for n in ("mean", "std"))
        if not (len(mean) == len(std) == 3 and min(std) > 0):
            raise InputError(
                f"{quote_path(folder)}: image_mean {quote(str(mean))} and image_std "
                f"{quote(str(std))} must be three numbers each, the latter positive."
            )
        return cls(height=values[0], width=values[1], mean=tuple(mean), std=tuple(std))


def normalize(images: torch.Tensor, mean: Sequence[float], std: Sequence[float]) -> torch.Tensor:
    """Return images `n 3 h w` in 8-bit levels, normalized to a network's statistics."""
    shift = images.new_tensor(mean)[:, None, None]
    return (images / 255 - shift) / images.new_tensor(std)[:, None, None]


def to_images(frames: np.ndarray, device: str) -> torch.Tensor:
    """Return video frames `n h w 3` as floating-point images `n 3 h w` in 8-bit levels."""
    import torch

    return torch.from_numpy(np.ascontiguousarray(frames)).to(device).movedim(-1, 1).float()


def resize_maps(maps: torch.Tensor, size: tuple[int, ...]) -> torch.Tensor:
    """Return maps `n h w` of numbers at another size."""
    from torch.nn.functional import interpolate

    scaled = interpolate(maps[:, None].float(), size=size, mode="bilinear", align_corners=False)
    return scaled[:, 0]


def resize_levels(images: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Return resized images in 8-bit levels, antialiased and rounded as by image libraries."""
    from torch.nn.functional import interpolate

    resized = interpolate(images, size=size, mode="bilinear", align_corners=False, antialias=True)
    return resized.round().clamp(0, 255)
