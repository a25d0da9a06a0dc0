"""Resize and cut videos for a model, with the same code in training and inference.

Every video is resized to the model's size, without cropping and without keeping the aspect ratio:
colors with Pillow's LANCZOS filter, masks with BILINEAR (EgoSim release). Videos of the right size
stay unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

import grain
import numpy as np
from jaxtyping import Int, UInt8
from PIL import Image

from egosim_jax.io.decoding import Decoding
from egosim_jax.io.images import decode_image
from egosim_jax.io.timing import MAX_RATE_RATIO
from egosim_jax.io.video import probe_video, read_video
from egosim_jax.types import InputError, VideoSpec

Resampling = Literal["first", "stride", "linspace", "rate", "step"]
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


def resample(
    count: int, frames: int, rule: Resampling, *, ratio: Fraction = Fraction(1)
) -> Int[np.ndarray, " n"]:
    """Return the indices of at most `frames` frames to take from a clip of `count`.

    `ratio` is the clip's frame rate divided by the model's.

    first      the first ones, without gaps
    stride     every (count // frames)-th from the first, as DWM's video loader does
    linspace   from the first to the last, equally spaced and rounded, as DWM's latent encoder does;
               a clip that is too short repeats frames
    rate       the nearest in time to the model's frames
    step       every n-th from the first, where n is `ratio` rounded down, as in the evaluation
               behind DWM's tables
    """
    match rule:
        case "linspace":
            return np.rint(np.linspace(0, count - 1, frames)).astype(int)
        case "rate":
            taken = [math.floor(number * ratio + Fraction(1, 2)) for number in range(frames)]
            return np.array([index for index in taken if index < count], int)
        case "first":
            step = 1
        case "stride":
            step = count // frames
        case "step":
            step = int(ratio)
    return np.arange(0, count, max(1, step))[:frames]


def rate_problem(fps: Fraction, model_fps: int) -> str | None:
    """Say how a clip's frame rate contradicts its model's; None if they agree within 1 %."""
    ratio = fps / model_fps
    if max(ratio, 1 / ratio) <= MAX_RATE_RATIO:
        return None
    return (
        f"{float(fps):g} frames a second are not the model's {model_fps}: everything would move "
        f"{float(1 / ratio):.3g} times as fast."
    )


def check_rates(fps: Fraction, model_fps: int, *, source: str = "The clip") -> None:
    """Raise `InputError` if the frame rate of packed clips is not the model's."""
    if problem := rate_problem(fps, model_fps):
        raise InputError(
            f"{source} cannot be used: {problem} Pack the clips again with frames nearest in time: "
            f"`egosim data pack --size HEIGHT WIDTH --resampling rate --fps {model_fps}`. "
            "(--shards)"
        )


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
    info = probe_video(prior.tobytes(), name="prior")
    return info.frames, info.height, info.width


def decode_record(
    arrays: Mapping[str, np.ndarray],
    spec: VideoSpec,
    *,
    start: int = 0,
    decoding: Decoding = "accurate",
    check_rate: bool = False,
) -> dict[str, np.ndarray]:
    """Return frames `[start, start + spec.frames)` of a record's videos, at the size of `spec`.

    Without a mask, every pixel is observed. Raises `InputError` naming the video that cannot be
    decoded, is too short or, with `check_rate`, has another frame rate.
    """
    fps = spec.fps if check_rate else None
    stop = start + spec.frames
    decoded: dict[str, np.ndarray] = {}
    absent = [name for name in ("prior", "hands", "first_frame") if name not in arrays]
    if absent:
        raise InputError(f"The record is not a clip: missing {', '.join(absent)}.")
    for name in (*COLORS, "mask"):
        if name not in arrays:
            continue
        frames = _frames(arrays[name], name, start, stop, decoding, fps)
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


def _frames(
    array: np.ndarray, name: str, start: int, stop: int, decoding: Decoding, fps: int | None
) -> np.ndarray:
    if array.ndim > 1:
        return array[start:stop]
    video = read_video(array.tobytes(), start=start, stop=stop, decoding=decoding, name=name)
    if fps is not None:
        check_rates(video.fps, fps)
    return video.frames


def _resize_all(frames: np.ndarray, height: int, width: int, how: Image.Resampling) -> np.ndarray:
    if frames.shape[1:3] == (height, width):
        return frames
    return np.stack([_resize(frame, height, width, how) for frame in frames])


def _resize(image: np.ndarray, height: int, width: int, how: Image.Resampling) -> np.ndarray:
    return np.asarray(Image.fromarray(image).resize((width, height), how))
