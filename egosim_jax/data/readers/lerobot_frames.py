"""Frames of an episode of a LeRobot dataset of version 3.0, from its video or from its table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.readers.lerobot import LeRobot, rate_of, table_of
from egosim_jax.io.bounded import listing, quote, quote_path, quote_text
from egosim_jax.io.images import decode_image
from egosim_jax.io.untrusted.parquet import read_image_rows
from egosim_jax.types import InputError

GROUP = 128
"""Number of images of a table that are read at once."""
Each = Callable[[np.ndarray], np.ndarray]


@no_type_check
@dataclass(frozen=True, kw_only=True)
class EpisodeFrames:
    """Frames of one camera of an episode; frame k is at k / fps seconds after the first."""

    count: int
    """Number of frames."""
    fps: Fraction
    """Frames per second."""
    first: UInt8[np.ndarray, "h w 3"]
    """First frame."""
    read: Callable[[int, Each], UInt8[np.ndarray, "f _ _ 3"]]
    """Function that decodes the first frames, so many, and applies a function to each."""


def frames_of(
    root: Path, info: Mapping[str, Any], episode: int, camera: str | None
) -> EpisodeFrames:
    """Return the frames of a camera, by default of the only one.

    Raises `InputError` if it is not clear which camera, or if frames are missing.
    """
    kinds = {
        name: feature.get("dtype")
        for name, feature in info["features"].items()
        if isinstance(feature, dict) and feature.get("dtype") in ("image", "video")
    }
    chosen = [name for name in kinds if camera in (None, name, name.rpartition(".")[2])]
    if len(chosen) != 1:
        listed = listing([quote_text(name) for name in kinds], limit=20) or "none"
        wanted = "one camera" if camera is None else f"a camera {quote(camera)}"
        raise InputError(
            f"{quote_path(root)} must have {wanted}, and has {listed}: name one of them in the "
            "robot's description. (recording.camera)"
        )
    if kinds[chosen[0]] == "video":
        return _of_video(root, episode, chosen[0])
    path, length = table_of(root, info, episode)
    name = f"{quote_path(path)}, frame 0"

    def read(count: int, each: Each) -> np.ndarray:
        images = []
        for start in range(0, count, GROUP):
            frames = range(start, min(start + GROUP, count))
            encoded = read_image_rows(path, chosen[0], episode, frames)
            images += [each(decode_image(data, name=quote_path(path))) for data in encoded]
        return np.stack(images)

    (first,) = read_image_rows(path, chosen[0], episode, [0])
    return EpisodeFrames(
        count=length, fps=rate_of(info), first=decode_image(first, name=name), read=read
    )


def _of_video(root: Path, episode: int, camera: str) -> EpisodeFrames:
    wanted = f"episode_{episode:06d}"
    entries = LeRobot(source=root, camera=camera).find()
    entry = next((entry for entry in entries if entry.recording_id == wanted), None)
    if entry is None:
        raise InputError(
            f"{quote_path(root)} has no video of episode {episode}: choose another. (--episode)"
        )
    recording = entry.read(root)
    first = recording.read_frames(0, 1).frames[0]
    return EpisodeFrames(
        count=recording.frames,
        fps=recording.fps,
        first=first,
        read=lambda count, each: recording.read_frames(0, count, each=each).frames,
    )
