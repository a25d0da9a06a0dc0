"""Contact sheets: videos as a page of pictures, where people would rather look than read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from egosim_jax.io.atomic import atomic_write

if TYPE_CHECKING:
    import numpy as np

TITLE_PX = 16


@dataclass(frozen=True)
class Block:
    """One clip on a sheet: a title, and videos of equal length and size below each other."""

    title: str
    videos: Sequence[np.ndarray]
    """uint8 RGB, each `f h w 3`."""


def draw_sheet(
    blocks: Sequence[Block], out: Path, *, moments: Sequence[int], width: int | None = None
) -> None:
    """Draw a row for each video, with its frames at `moments` (the last for any later one).

    Each picture is stretched to `width` pixels, if given.
    """
    import numpy as np
    from PIL import Image, ImageDraw

    from egosim_jax.data.transforms import resize_video

    rows = []
    for block in blocks:
        for number, video in enumerate(block.videos):
            frames = video[[min(moment, len(video) - 1) for moment in moments]]
            if width is not None:
                _, rows_px, columns_px, _ = frames.shape
                frames = resize_video(frames, round(rows_px * width / columns_px), width)
            row = np.concatenate(list(frames), axis=1)
            if number == 0:
                header = Image.new("RGB", (row.shape[1], TITLE_PX), "white")
                ImageDraw.Draw(header).text((2, 2), block.title, fill="black")
                rows.append(np.asarray(header))
            rows.append(row)
    with atomic_write(out) as temporary:
        Image.fromarray(np.concatenate(rows)).save(temporary)
