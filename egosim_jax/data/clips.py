"""Read and write clips as files, checked and at a model's length and size.

The strict policy, the default, rejects clips that the lenient one repairs: a missing mask, videos
whose frame counts disagree or are not 4k+1, sizes that disagree or are not multiples of 16, and
clips shorter than the model's. The lenient policy does what the EgoSim release does. It repeats the
last frame or cuts the video, resizes every video, and treats every pixel as observed if there is no
mask. A warning reports the number of missing frames. With both, a longer clip yields the window
that starts at `start`.
"""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from egosim_jax.data.clip_files import SAFE_IDS, ClipFiles, is_safe_id
from egosim_jax.data.metadata import MASK_NAME, csv_rows
from egosim_jax.data.transforms import (
    Resampling,
    fit_length,
    rate_problem,
    resample,
    resize_image,
    resize_mask,
)
from egosim_jax.io.atomic import atomic_write, lock_folder
from egosim_jax.io.bounded import listing, quote, quote_path, quote_text, read_bytes
from egosim_jax.io.decoding import Damage, Decoding
from egosim_jax.io.images import MAX_IMAGE_BYTES, read_image
from egosim_jax.io.run import write_text
from egosim_jax.io.timing import CONVERT, MAX_RATE_RATIO
from egosim_jax.io.video import VIDEO_SUFFIXES, VideoInfo, probe_video, read_video
from egosim_jax.io.writing import write_video
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import WAN_GRID, InputError, Triplet, VideoGrid, VideoSpec

logger = logging.getLogger(__name__)

Policy = Literal["strict", "lenient"]
DAMAGE: dict[Policy, Damage] = {"strict": "refuse", "lenient": "stop"}
LENIENT = "egosim generate --lenient"
"""The one command with the lenient policy, and its option."""
MAX_STRETCH = 1.5
"""Maximum ratio of the factors of the two sides of a video that is resized."""


def write_clips(
    folder: Path, triplets: Iterable[Triplet], *, fps: int | Fraction, append: bool = False
) -> Path:
    """Write triplets as files in EgoSim's layout; return the path of their metadata.csv.

    Each clip has a folder; the entries of `extra` become columns. All clips must have the same
    columns, and either all or none must have a target video. `append` keeps the other clips' rows
    in an existing metadata.csv, including rows that other processes append meanwhile. Raises
    `InputError` for an id that is not a valid file name.
    """
    path = folder / "metadata.csv"
    rows = {triplet.video_id: write_clip(folder, triplet, fps=fps) for triplet in triplets}
    if not append:
        write_table(path, list(rows.values()))
        return path
    with lock_folder(folder, wait=True):
        before = csv_rows(path) if path.exists() else ()
        rows = {row.get("video_id", ""): row for _, row in before} | rows
        write_table(path, list(rows.values()))
    return path


def write_clip(folder: Path, triplet: Triplet, *, fps: int | Fraction) -> dict[str, str]:
    """Write the files of one triplet; return its row of the table (`write_table`).

    Raises `InputError` for an id that is not a valid file name.
    """
    name = triplet.video_id
    if not is_safe_id(name):
        raise InputError(f"video_id {quote(name)} is not a valid file name; use {SAFE_IDS}.")
    videos = {
        "ego_prior_video.mp4": triplet.prior,
        "hand_keypoint_video.mp4": triplet.hands,
        MASK_NAME: np.repeat(triplet.mask[..., None], 3, axis=-1),
    }
    row = {
        "ego_prior_video": f"{name}/ego_prior_video.mp4",
        "hand_keypoint_video": f"{name}/hand_keypoint_video.mp4",
        "first_frame": f"{name}/first_frame.png",
        "prompt": triplet.prompt,
        "video_id": name,
        **triplet.extra,
    }
    if triplet.target is not None:
        videos["video.mp4"] = triplet.target
        row = {"video": f"{name}/video.mp4", **row}
    for file, frames in videos.items():
        write_video(folder / name / file, frames, fps)
    with atomic_write(folder / name / "first_frame.png") as temporary:
        Image.fromarray(triplet.first_frame).save(temporary)
    return row


def write_table(path: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Write rows of equal columns as metadata.csv. Raises `InputError` if columns differ."""
    columns = list(rows[-1])
    for row in rows:
        if row.keys() != set(columns):
            raise InputError(
                f"{quote_path(path)}: the clips of a table must have the same columns, not "
                f"{quote_text(', '.join(row))} and {quote_text(', '.join(columns))}. Write them "
                "to another folder."
            )
    table = io.StringIO()
    writer = csv.DictWriter(table, fieldnames=columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, table.getvalue())


def check_clip(
    files: ClipFiles,
    spec: VideoSpec | None,
    *,
    start: int = 0,
    policy: Policy = "strict",
    grid: VideoGrid = WAN_GRID,
    resampling: Resampling = "first",
    fps: int | None = None,
) -> list[str]:
    """List the problems that would make `load_triplet` fail, without decoding the videos.

    Each problem names the metadata row and the file. Without a `spec`, every length is accepted.
    With frames taken at intervals, every sufficient length is accepted. `fps` is the frame rate to
    have; by default the one of `spec`.
    """
    fps = spec.fps if spec is not None and fps is None else fps
    problems = []
    probed: dict[str, VideoInfo] = {}
    sizes: dict[str, tuple[int, int]] = {}
    for name, path in videos_of(files, policy).items():
        try:
            probed[name] = probe_video(path, damage=DAMAGE[policy])
            sizes[name] = (probed[name].height, probed[name].width)
        except InputError as error:
            problems.append(str(error))
    try:
        sizes["first_frame"] = _read_first_frame(files.first_frame).shape[:2]
    except InputError as error:
        problems.append(str(error))
    if resampling in ("rate", "step") or (resampling == "first" and policy == "strict"):
        problems += _rate_problems(probed) or _model_problems(probed, fps, resampling)
    if policy == "strict":
        taken = _taken(probed, spec, resampling)
        problems += _length_problems(probed, taken, start + (spec.frames if spec else 1), grid)
        problems += _size_problems(sizes, grid.spatial_stride * grid.patch)
        problems += _shape_problems(sizes, spec) if spec else []
    return [f"{files.row} ({files.video_id}): {problem}" for problem in problems]


def load_triplet(
    files: ClipFiles,
    spec: VideoSpec,
    *,
    start: int = 0,
    policy: Policy = "strict",
    decoding: Decoding = "accurate",
    grid: VideoGrid = WAN_GRID,
    resampling: Resampling = "first",
) -> Triplet:
    """Read frames `[start, start + spec.frames)` of a clip at the size of `spec`.

    Another `resampling` takes the same frames of every video, out of all its frames, and has no
    `start`. The CLIP image is the clip's, whatever the window. Raises `InputError` with the
    problems of `check_clip`, or naming a damaged video.
    """
    if start and resampling != "first":
        raise InputError(
            f"The rule {resampling} takes frames of the complete clip: it must start at 0, not "
            f"{start}. (--resampling)"
        )
    problems = check_clip(files, spec, start=start, policy=policy, grid=grid, resampling=resampling)
    if problems:
        raise InputError(listing(problems))
    arrays: dict[str, np.ndarray] = {
        "mask": np.zeros((spec.frames, spec.height, spec.width), np.uint8)
    }
    videos = videos_of(files, policy)
    ratio = Fraction(1)
    if resampling in ("rate", "step"):
        probed = {name: probe_video(path, damage=DAMAGE[policy]) for name, path in videos.items()}
        ratio = _ratio(probed, spec)
    for name, path in videos.items():
        fit = _fit_mask if name == "mask" else resize_image
        try:
            video = read_video(
                path,
                start=start,
                stop=start + spec.frames if resampling == "first" else None,
                decoding=decoding,
                damage=DAMAGE[policy],
                each=partial(fit, height=spec.height, width=spec.width),
            )
            frames = video.frames[resample(len(video.frames), spec.frames, resampling, ratio=ratio)]
        except InputError as error:
            raise InputError(f"{files.row} ({files.video_id}): {error}") from error
        if len(frames) < spec.frames:
            missing = spec.frames - len(frames)
            why = (
                f"{files.row} ({files.video_id}): {missing} of {spec.frames} frames are missing in "
                f"{quote_path(path)}"
            )
            if policy == "strict":
                raise InputError(f"{why}. ({LENIENT} repeats the last frame)")
            logger.warning("%s; the last frame is repeated", printable(why))
        arrays[name] = fit_length(frames, spec.frames)
    image = _read_first_frame(files.first_frame, decoding)
    return Triplet(
        video_id=files.video_id,
        prompt=files.prompt,
        first_frame=resize_image(image, spec.height, spec.width),
        extra=files.extra,
        **arrays,
    )


def _fit_mask(frame: UInt8[np.ndarray, "h w 3"], *, height: int, width: int) -> np.ndarray:
    return resize_mask(frame[None, ..., 0], height, width)[0]


def videos_of(files: ClipFiles, policy: Policy = "strict") -> dict[str, Path]:
    """Return the videos to read; the lenient policy omits a missing mask or target."""
    videos = {"prior": files.prior, "hands": files.hands}
    for name, path in (("mask", files.mask), ("target", files.target)):
        if path is not None and (policy == "strict" or path.exists()):
            videos[name] = path
    return videos


def _taken(
    probed: dict[str, VideoInfo], spec: VideoSpec | None, resampling: Resampling
) -> dict[str, int]:
    """Return the number of frames of each video that can be taken."""
    if spec is None or resampling == "first":
        return {name: info.frames for name, info in probed.items()}
    ratio = _ratio(probed, spec)
    return {
        name: len(resample(info.frames, spec.frames, resampling, ratio=ratio))
        for name, info in probed.items()
    }


def _ratio(probed: dict[str, VideoInfo], spec: VideoSpec) -> Fraction:
    """Return the rate of the videos, by the target or the prior, divided by the model's."""
    timed = probed.get("target") or probed.get("prior")
    return timed.fps / spec.fps if timed else Fraction(1)


def _model_problems(
    probed: dict[str, VideoInfo], fps: int | None, resampling: Resampling
) -> list[str]:
    """List how the videos' rate contradicts the rate to have."""
    timed = probed.get("target") or probed.get("prior")
    if timed is None or fps is None:
        return []
    if resampling != "first":
        slow = timed.fps * MAX_RATE_RATIO < fps
        return [f"{rate_problem(timed.fps, fps)} (--resampling {resampling})"] if slow else []
    if (problem := rate_problem(timed.fps, fps)) is None:
        return []
    return [
        f"{problem} Take the frames nearest in time (`egosim data pack --resampling rate`), or "
        f"write all videos at this rate with `{CONVERT.format(fps)}`. ({LENIENT} does not look)"
    ]


def _rate_problems(probed: dict[str, VideoInfo]) -> list[str]:
    rates = {name: info.fps for name, info in probed.items()}
    if not rates or max(rates.values()) <= MAX_RATE_RATIO * min(rates.values()):
        return []
    return [
        f"the frame rates disagree: {_table({n: f'{float(r):g}' for n, r in rates.items()})}. "
        "Frame k of each must be of one time. Write all at one rate, for instance with "
        f"`{CONVERT.format(f'{float(min(rates.values())):.6g}')}`, which keeps times, or `ffmpeg "
        f"-r {float(min(rates.values())):.6g} -i IN OUT`, which keeps frames. "
        f"The rule linspace and {LENIENT} do not look at rates. (--resampling)"
    ]


def _length_problems(
    probed: dict[str, VideoInfo], taken: dict[str, int], needed: int, grid: VideoGrid
) -> list[str]:
    counts = {name: info.frames for name, info in probed.items()}
    if len(set(counts.values())) > 1:
        return [f"the frame counts disagree: {_table(counts)}. ({LENIENT} repeats or cuts)"]
    problems = []
    for count in set(taken.values()):
        try:
            grid.check_frames(count, what="a clip", fix=f"{LENIENT} cuts or repeats frames")
        except InputError as error:
            problems.append(str(error))
        if count < needed:
            problems.append(
                f"{count} frames are fewer than the {needed} that the window needs. "
                f"({LENIENT} repeats the last frame)"
            )
    return problems


def _size_problems(sizes: dict[str, tuple[int, int]], unit: int) -> list[str]:
    written = {name: f"{width}x{height}" for name, (height, width) in sizes.items()}
    if len(set(written.values())) > 1:
        return [f"the sizes disagree: {_table(written)}. ({LENIENT} resizes each)"]
    return [
        f"{width}x{height} pixels: width and height must be multiples of {unit}. "
        f"({LENIENT} resizes)"
        for height, width in set(sizes.values())
        if height % unit or width % unit
    ]


def _shape_problems(sizes: dict[str, tuple[int, int]], spec: VideoSpec) -> list[str]:
    problems = []
    for height, width in set(sizes.values()):
        stretch = (spec.width * height) / (spec.height * width)
        if max(stretch, 1 / stretch) > MAX_STRETCH:
            problems.append(
                f"{width}x{height} pixels would be stretched to {spec.width}x{spec.height}: one "
                f"side by {max(stretch, 1 / stretch):.2g} times as much as the other, more than "
                f"{MAX_STRETCH:g}. Crop the videos, or choose another model. ({LENIENT} stretches)"
            )
    return problems


def _table(values: dict[str, int] | dict[str, str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items())


def _read_first_frame(path: Path, decoding: Decoding = "accurate") -> UInt8[np.ndarray, "h w 3"]:
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return read_video(path, stop=1, decoding=decoding).frames[0]
    return read_image(path)


def encoded_first_frame(path: Path) -> bytes:
    """Return an image file, or the first frame of a video as PNG."""
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        return read_bytes(path, limit=MAX_IMAGE_BYTES)
    buffer = io.BytesIO()
    Image.fromarray(_read_first_frame(path)).save(buffer, "PNG")
    return buffer.getvalue()
