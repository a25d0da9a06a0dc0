"""Contact sheets: frames of several videos in one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from egosim_jax.io.atomic import atomic_write

if TYPE_CHECKING:
    import numpy as np

TITLE_PX = 16
"""Height of a title in pixels."""


@dataclass(frozen=True)
class SheetClip:
    """One clip on a contact sheet: a title and videos of equal length and size."""

    title: str
    """Text above the videos."""
    videos: Sequence[np.ndarray]
    """RGB videos, uint8, each `f h w 3`."""


def draw_sheet(
    clips: Sequence[SheetClip], out: Path, *, moments: Sequence[int], width: int | None = None
) -> None:
    """Draw one row per video of each clip, with the frames at the indices `moments`.

    The last frame replaces frames beyond the end. Frames are resized to `width` pixels, if given.
    """
    import numpy as np
    from PIL import Image, ImageDraw

    from egosim_jax.data.transforms import resize_video

    rows = []
    for clip in clips:
        for number, video in enumerate(clip.videos):
            frames = video[[min(moment, len(video) - 1) for moment in moments]]
            if width is not None:
                _, rows_px, columns_px, _ = frames.shape
                frames = resize_video(frames, round(rows_px * width / columns_px), width)
            row = np.concatenate(list(frames), axis=1)
            if number == 0:
                header = Image.new("RGB", (row.shape[1], TITLE_PX), "white")
                ImageDraw.Draw(header).text((2, 2), clip.title, fill="black")
                rows.append(np.asarray(header))
            rows.append(row)
    with atomic_write(out) as temporary:
        Image.fromarray(np.concatenate(rows)).save(temporary)
