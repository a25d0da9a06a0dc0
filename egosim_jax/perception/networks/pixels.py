"""Preprocessing of frames for networks whose image processors need torchvision, without it.

All functions run in a worker. The sizes and statistics are those that the checkpoint's own
processor files give.
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
"""Largest side of a network's input in pixels."""


@dataclass(frozen=True, kw_only=True)
class PixelSettings:
    """Size and statistics of a network's input images."""

    height: int
    width: int
    mean: tuple[float, ...]
    std: tuple[float, ...]

    @classmethod
    def read(cls, folder: Path, default: PixelSettings) -> PixelSettings:
        """Return the settings of a checkpoint's processor files; the default for what none gives.

        Read are the entry of video_preprocessor_config.json, of preprocessor_config.json, or of
        processor_config.json, in this order.
        """
        found: dict[str, Any] = {}
        for name in ("processor_config", "preprocessor_config", "video_preprocessor_config"):
            path = folder / f"{name}.json"
            if path.is_file():
                content = read_json(path)
                for part in ("image_processor", "video_processor"):
                    found |= content.get(part) or {}
                found |= content
        size = found.get("size") or {"height": default.height, "width": default.width}
        values = tuple(size.get(side) or 0 for side in ("height", "width"))
        if not all(isinstance(v, int) and 0 < v <= MAX_SIZE for v in values):
            raise InputError(
                f"{quote_path(folder)}: size {quote(str(size))} of its image processor is not a "
                f"height and a width of at most {MAX_SIZE} pixels. Download its files again."
            )
        mean, std = (found.get(f"image_{n}") or getattr(default, n) for n in ("mean", "std"))
        if not (len(mean) == len(std) == 3 and min(std) > 0):
            raise InputError(
                f"{quote_path(folder)}: image_mean {quote(str(mean))} and image_std "
                f"{quote(str(std))} must be three numbers each, the latter positive."
            )
        return cls(height=values[0], width=values[1], mean=tuple(mean), std=tuple(std))


def normalize(images: torch.Tensor, mean: Sequence[float], std: Sequence[float]) -> torch.Tensor:
    """Return images `n 3 h w` of 8-bit levels, shifted and scaled to a network's statistics."""
    shift = images.new_tensor(mean)[:, None, None]
    return (images / 255 - shift) / images.new_tensor(std)[:, None, None]


def to_images(frames: np.ndarray, device: str) -> torch.Tensor:
    """Return frames `n h w 3` of a video as floating-point images `n 3 h w` of 8-bit levels."""
    import torch

    return torch.from_numpy(np.ascontiguousarray(frames)).to(device).movedim(-1, 1).float()


def resize_levels(images: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Return images of 8-bit levels resized as image libraries do: smoothed, and rounded again."""
    from torch.nn.functional import interpolate

    resized = interpolate(images, size=size, mode="bilinear", align_corners=False, antialias=True)
    return resized.round().clamp(0, 255)
