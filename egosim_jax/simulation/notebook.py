"""Data as HTML, which a notebook shows: videos move, states are drawn from three sides."""

from __future__ import annotations

import html as escaping
from base64 import b64encode
from dataclasses import fields
from io import BytesIO
from typing import Any

import numpy as np
from PIL import Image

from egosim_jax.rendering.portrait import portrait
from egosim_jax.state.planes import vertical
from egosim_jax.types import Clip, SceneState
from egosim_jax.types.arrays import Video

MAX_FRAMES = 65
"""Number of a video's frames that are shown; a page with more would be slow."""


def html(value: Any) -> str:
    """Return the short text of data (`types.Shown`), and images of it and its fields."""
    parts = [getattr(value, field.name) for field in fields(value)]
    images = [_image_of(part) for part in [value, *parts] if isinstance(part, (Clip, SceneState))]
    text = f"<code>{escaping.escape(repr(value))}</code>"
    return "<div>" + "<br>".join([*images, text]) + "</div>"


def _image_of(value: Clip | SceneState) -> str:
    if isinstance(value, Clip):
        return _image(value.frames[:MAX_FRAMES], fps=value.fps)
    if not len(value.points_m):
        return "(no points)"
    return _image(np.concatenate(list(portrait(value, up=vertical(value))), axis=1)[None], fps=1)


def _image(frames: Video, *, fps: int) -> str:
    """Return a WebP image, which repeats if it has several frames."""
    first, *others = map(Image.fromarray, frames)
    file = BytesIO()
    first.save(
        file, "WEBP", save_all=True, append_images=others, duration=round(1000 / fps), loop=0
    )
    data = b64encode(file.getvalue()).decode("ascii")
    return f'<img src="data:image/webp;base64,{data}" style="max-width: 100%">'
