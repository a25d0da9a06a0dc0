"""Resize and cut videos for a model, with the same code in training and inference.

Every video is resized to the model's size, without cropping and without keeping the aspect ratio:
colors with Pillow's LANCZOS filter, masks with BILINEAR (EgoSim release). Videos of the right size
stay unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import grain
import numpy as np
from jaxtyping import Int, UInt8
from PIL import Image

from egosim_jax.io.decoding import Decoding
from egosim_jax.io.images import decode_image
from egosim_jax.io.video import decode_video, probe_encoded
from egosim_jax.types import InputError, VideoSpec

Resampling = Literal["first", "stride", "linspace", "rate"]
"""Rule that chooses the frames of a clip (`resample`)."""
COLORS = ("target", "prior", "hands")
"""Names of the color videos of a record."""


def resize_image(
    image: UInt8[np.ndarray, "h w 3"], height: int, width: int
) -> UInt8[np.ndarray, "height width 3"]:
    """Resize an RGB image with LANCZOS."""
    return _resize(image, height, width, Image.Resampling.LANCZOS)


def resize_video(
    frames: UInt8[np.ndarray, "f h w 3"], height: int, width: int
) -> UInt8[np.ndarray, "f height width 3"]:
    """Resize every frame of an RGB video with LANCZOS."""
    return _resize_all(frames, height, width, Image.Resampling.LANCZOS)


def resize_mask(
    mask: UInt8[np.ndarray, "f h w"], height: int, width: int
) -> UInt8[np.ndarray, "f height width"]:
    """Resize every frame of a mask with BILINEAR; edges become gray levels."""
    return _resize_all(mask, height, width, Image.Resampling.BILINEAR)


def resample(count: int, frames: int, rule: Resampling, *, step: int = 1) -> Int[np.ndarray, " n"]:
    """Return the indices of at most `frames` frames to take from a clip of `count`.

    first      the first ones, without gaps
    stride     every (count // frames)-th from the first, as DWM's video loader does
    linspace   from the first to the last, equally spaced and rounded, as DWM's latent encoder does;
               a clip that is too short repeats frames
    rate       every `step`-th from the first, as in the evaluation behind DWM's tables, whose step
               is the clip's frame rate divided by 8, rounded down
    """
    match rule:
        case "linspace":
            return np.rint(np.linspace(0, count - 1, frames)).astype(int)
        case "stride":
            step = max(1, count // frames)
        case "first":
            step = 1
    return np.arange(0, count, max(1, step))[:frames]


def fit_length(frames: UInt8[np.ndarray, "f ..."], count: int) -> UInt8[np.ndarray, "g ..."]:
    """Return the first `count` frames; repeat the last one if there are too few."""
    return frames[np.minimum(np.arange(count), len(frames) - 1)]


@dataclass(frozen=True)
class DecodeWindow(grain.transforms.RandomMap):
    """A transform that cuts a random window of `spec.frames` frames out of a record.

    Takes records of kind "videos", which it decodes, and of kind "frames". Returns `target`,
    `prior`, `hands`, `mask` and `first_frame`, which is the clip's image for every window.
    """

    spec: VideoSpec
    """Length and size of the window."""

    def random_map(self, element: Mapping[str, np.ndarray], rng: np.random.Generator) -> Any:
        """Cut the same window out of every video. Raises `InputError` if the clip is shorter."""
        length = video_shape(element)[0]
        if length < self.spec.frames:
            raise InputError(f"{length} frames are fewer than the window's {self.spec.frames}.")
        start = int(rng.integers(0, length - self.spec.frames + 1))
        return decode_record(element, self.spec, start=start)


@dataclass(frozen=True)
class RandomCrop(grain.transforms.RandomMap):
    """A random crop, `rows x columns`, of a random window of one of a record's color videos."""

    spec: VideoSpec
    size: tuple[int, int]
    probs: tuple[float, float, float]
    """Probabilities of the videos in `COLORS`."""

    def random_map(self, element: Mapping[str, np.ndarray], rng: np.random.Generator) -> Any:
        """Return the crop as `video`."""
        stream = str(rng.choice(COLORS, p=self.probs))
        video = DecodeWindow(self.spec).random_map(element, rng)[stream]
        rows, columns = self.size
        top = int(rng.integers(0, self.spec.height - rows + 1))
        left = int(rng.integers(0, self.spec.width - columns + 1))
        return {"video": video[:, top : top + rows, left : left + columns]}


def video_shape(arrays: Mapping[str, np.ndarray]) -> tuple[int, int, int]:
    """Return frames, height and width of a record's prior, encoded or decoded."""
    prior = arrays.get("prior")
    if prior is None:
        raise InputError("The record is not a clip: prior is missing.")
    if prior.ndim > 1:
        return prior.shape[0], prior.shape[1], prior.shape[2]
    info = probe_encoded(prior.tobytes(), name="prior")
    return info.frames, info.height, info.width


def decode_record(
    arrays: Mapping[str, np.ndarray],
    spec: VideoSpec,
    *,
    start: int = 0,
    decoding: Decoding = "accurate",
) -> dict[str, np.ndarray]:
    """Return frames `[start, start + spec.frames)` of a record's videos, at the size of `spec`.

    Without a mask, every pixel is observed. Raises `InputError` naming the video that cannot be
    decoded or is too short.
    """
    stop = start + spec.frames
    decoded: dict[str, np.ndarray] = {}
    absent = [name for name in ("prior", "hands", "first_frame") if name not in arrays]
    if absent:
        raise InputError(f"The record is not a clip: missing {', '.join(absent)}.")
    for name in (*COLORS, "mask"):
        if name not in arrays:
            continue
        frames = _frames(arrays[name], name, start, stop, decoding)
        if len(frames) < spec.frames:
            raise InputError(f"{name} ends before frame {stop}.")
        if name == "mask":
            mask = frames if frames.ndim == 3 else frames[..., 0]
            decoded[name] = resize_mask(mask, spec.height, spec.width)
        else:
            decoded[name] = resize_video(frames, spec.height, spec.width)
    if "mask" not in decoded:
        decoded["mask"] = np.zeros((spec.frames, spec.height, spec.width), np.uint8)
    image = arrays["first_frame"]
    image = decode_image(image.tobytes(), name="first_frame") if image.ndim == 1 else image
    decoded["first_frame"] = resize_image(image, spec.height, spec.width)
    return decoded


def _frames(array: np.ndarray, name: str, start: int, stop: int, decoding: Decoding) -> np.ndarray:
    if array.ndim > 1:
        return array[start:stop]
    return decode_video(
        array.tobytes(), start=start, stop=stop, decoding=decoding, name=name
    ).frames


def _resize_all(frames: np.ndarray, height: int, width: int, how: Image.Resampling) -> np.ndarray:
    if frames.shape[1:3] == (height, width):
        return frames
    return np.stack([_resize(frame, height, width, how) for frame in frames])


def _resize(image: np.ndarray, height: int, width: int, how: Image.Resampling) -> np.ndarray:
    return np.asarray(Image.fromarray(image).resize((width, height), how))
