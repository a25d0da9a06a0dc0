"""EgoDex: headset videos with ARKit's poses of the camera and of both hands.

    <split>/<task>/<id>.hdf5 and .mp4, 1920x1080, 30 frames per second
        camera/intrinsic          3 3, pixels
        transforms/<name>         f 4 4, `name` to world, meters: camera and 68 joints
        confidences/<joint>       f, 0 to 1; 1 where it is absent
        attributes                llm_description, llm_description2, which_llm_description,
                                  llm_type, llm_objects

EgoSim's cuts of such files, `<id>_<start>_<end>.hdf5` with 121 poses at 16 frames per second, have
cameras but no hands. The camera's axes are OpenCV's; the world is ARKit's, y up, with an arbitrary
origin. The dataset has 25 joints per hand. Our 21 omit the four metacarpals: they are the wrist
(`Hand`), the thumb from Knuckle to Tip, and Knuckle, IntermediateBase, IntermediateTip and Tip of
index, middle, ring and little finger. A hand without one of them is unknown.
Pixel coordinates start at the corner of the image (its center is at 960, 540), so half a pixel is
subtracted. Followed: Apple's loader as of 2025.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import tyro
from einops import rearrange
from jaxtyping import Float

from egosim_jax.data.pairing import pair_rows
from egosim_jax.data.readers import Entry, find_files, make_id, require
from egosim_jax.data.readers.hands import with_joints
from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import listing, quote_path
from egosim_jax.io.untrusted.hdf5 import read_hdf5
from egosim_jax.io.video import probe_video
from egosim_jax.types import InputError

logger = logging.getLogger(__name__)

_SEGMENTS = ("Knuckle", "IntermediateBase", "IntermediateTip", "Tip")
_FINGERS = ("Thumb", "IndexFinger", "MiddleFinger", "RingFinger", "LittleFinger")
JOINT_NAMES = ("Hand", *(finger + segment for finger in _FINGERS for segment in _SEGMENTS))
"""The dataset's names of our 21 keypoints, without the side."""
SIDES = ("left", "right")
TEXTS = ("llm_description", "llm_description2", "which_llm_description", "llm_type", "llm_objects")
"""Attributes to read."""


@dataclass(frozen=True, kw_only=True)
class EgoDex:
    """Apple's EgoDex: hdf5 and mp4 per episode, with cameras and hands."""

    dataset: ClassVar[str] = "egodex"
    source: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset, a split or a task, or one .hdf5 file."""
    min_confidence: float = 0.1
    """Minimum median confidence of a hand's joints; below it, the hand is missing in a frame."""

    def find(self) -> Iterator[Entry]:
        """List the .hdf5 files."""
        require("h5py")
        root = self.source if self.source.is_dir() else self.source.parent
        for path in find_files(self.source, "*.hdf5", kind="episode of EgoDex"):
            yield Entry(
                recording_id=make_id(path.relative_to(root).with_suffix("").parts),
                read=partial(self._read, path),
                source=path,
                options={"--min-confidence": str(self.min_confidence)},
            )

    def _read(self, path: Path, folder: Path) -> Recording:
        video = path.with_suffix(".mp4")
        info = probe_video(video)
        names = [side + name for side in SIDES for name in JOINT_NAMES]
        file = read_hdf5(
            path,
            {"transforms/camera": (None, 4, 4)},
            optional={
                "camera/intrinsic": (3, 3),
                **{f"transforms/{name}": (None, 4, 4) for name in names},
                **{f"confidences/{name}": (None,) for name in names},
            },
            texts=TEXTS,
        )
        poses, intrinsics = file.arrays["transforms/camera"], file.arrays.get("camera/intrinsic")
        rows = pair_rows(video, info, len(poses), what="camera poses")
        intrinsics = _fit_intrinsics(intrinsics, info.height, info.width)
        joints, unknown = self._joints(file.arrays, names)
        if intrinsics is None:
            unknown = ["camera/intrinsic", *unknown]
        if unknown:
            logger.warning(
                "%s: %s: missing, empty or of another length; this part stays unknown",
                quote_path(path), listing(unknown),
            )  # fmt: skip
        caption, objects = _texts(file.texts)
        recording = Recording.of_video(
            video,
            info,
            frames=len(rows),
            world_from_camera=poses[rows],
            intrinsics_px=intrinsics,
            metric=True,
            caption=caption or None,
            names=objects,
        )
        return with_joints(recording, None if joints is None else joints[rows])

    def _joints(
        self, arrays: Mapping[str, np.ndarray], names: list[str]
    ) -> tuple[Float[np.ndarray, "f 2 21 3"] | None, list[str]]:
        """Return the joints of both hands, None if the file has none, and what it lacks of them."""
        if not any(f"transforms/{name}" in arrays for name in names):
            return None, []
        frames = len(arrays["transforms/camera"])
        complete = {name: array for name, array in arrays.items() if len(array) == frames}
        unknown = [path for name in names if (path := f"transforms/{name}") not in complete]
        nowhere, certain = np.full((frames, 4, 4), np.nan), np.ones(frames)
        moved = [complete.get(f"transforms/{name}", nowhere)[:, :3, 3] for name in names]
        joints = rearrange(np.stack(moved, axis=1), "f (n j) c -> f n j c", n=2)
        confidences = [complete.get(f"confidences/{name}", certain) for name in names]
        confidence = rearrange(np.stack(confidences), "(n j) f -> f n j", n=2)
        joints[np.median(confidence, axis=2) < self.min_confidence] = np.nan
        return joints, unknown


def _fit_intrinsics(
    intrinsics: Float[np.ndarray, "3 3"] | None, height: int, width: int
) -> Float[np.ndarray, "3 3"] | None:
    """Return intrinsics with pixel centers at integers, for a video that may have been resized.

    Zeros or NaN are unknown intrinsics. The principal point is the image
    center, so it gives the size of the original image.
    """
    if intrinsics is None or not np.isfinite(intrinsics).all() or not intrinsics.any():
        return None
    columns, rows = 2 * intrinsics[0, 2], 2 * intrinsics[1, 2]
    if not (columns > 0 and rows > 0 and abs(columns * height - rows * width) < 2 * columns):
        raise InputError(
            f"camera/intrinsic is for an image of {columns:g}x{rows:g}, the video has "
            f"{width}x{height}: it must have the same aspect. Use the matching video."
        )
    fitted = intrinsics.copy()
    fitted[:2] *= width / columns
    fitted[:2, 2] -= 0.5
    return fitted


def _texts(texts: Mapping[str, tuple[str, ...]]) -> tuple[str, tuple[str, ...]]:
    """Return the caption and the names of objects.

    For a reversible task, `which_llm_description` says which direction was recorded.
    """
    first = {name: values[0] for name, values in texts.items() if values}
    reversible = first.get("llm_type") == "reversible"
    second = reversible and first.get("which_llm_description") == "2"
    caption = first.get("llm_description2" if second else "llm_description", "")
    return caption, texts["llm_objects"]
