"""Perception that was done elsewhere: the files that the official pipeline writes.

    pose/NAME.npz         data `f 4 4`, camera to world, OpenCV axes; inds `f`, the frames
    intrinsics/NAME.npz   data `f 4`, fx fy cx cy in pixels; inds `f`
    depth/NAME.zip        00000.exr ..., half floats, channel Z, meters; 0 or NaN is unknown
    mask/NAME.zip         00000.png ..., 8 bits, the id of what each pixel shows; 0 is background
    mask/NAME.txt         a line a thing, `id: phrase`

Source: EgoSim's `continuous_simulation`, a modified ViPE; see the released `utils/io.py` and
`reconstruct_from_artifacts`.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int32

from egosim_jax.io.npz import DAMAGE, read_arrays
from egosim_jax.io.untrusted import open_regular, quote, quote_text, read_bytes
from egosim_jax.perception import Backends
from egosim_jax.state.align import CameraMethod, align_cameras
from egosim_jax.state.filter import is_hand
from egosim_jax.types import Action, Cameras, Clip, InputError, SceneState

IDS_A_STEP = 1000
"""Ids of one clip mean nothing in the next: each step has numbers of its own."""
LARGEST_BYTES, LARGEST_PIXELS, LARGEST_TEXT = 2**28, 2**25, 2**20
"""Of one unpacked frame, and of the list of phrases in bytes."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """The files of one clip, brought into the world by its cameras."""

    folder: Path
    name: str
    alignment: CameraMethod = "orientations"
    """How the recorded cameras are laid over the action's."""

    def backends(self) -> Backends:
        """The perception that reads these files."""
        return Backends(
            poses=self.poses,
            depth=self.depth,
            segmentation=self.segmentation,
            tracking=lambda clip, action, state: {},
            naming=self.naming,
        )

    def poses(self, clip: Clip, action: Action, state: SceneState) -> Cameras:
        """The recorded cameras in the world."""
        there = self._frames("pose", clip, 4, 4)
        motion = align_cameras(there, action.cameras.world_from_camera, method=self.alignment)
        scale = np.cbrt(np.linalg.det(motion[:3, :3]))
        poses = motion @ there
        poses[:, :3, :3] /= scale
        fx, fy, cx, cy = self._frames("intrinsics", clip, 4).mean(axis=0)
        return Cameras(
            world_from_camera=poses,
            intrinsics_px=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            height=clip.frames.shape[1],
            width=clip.frames.shape[2],
        )

    def depth(self, clip: Clip, action: Action, state: SceneState) -> Float32[np.ndarray, "f h w"]:
        """The recorded depth in meters of the world; infinite where it is 0 or NaN."""
        there = self._frames("pose", clip, 4, 4)
        motion = align_cameras(there, action.cameras.world_from_camera, method=self.alignment)
        depth = np.cbrt(np.linalg.det(motion[:3, :3])) * self._pictures("depth", clip)
        return np.where(depth > 0, depth, np.inf).astype(np.float32)

    def segmentation(
        self, clip: Clip, action: Action, state: SceneState
    ) -> Int32[np.ndarray, "f h w"]:
        """The recorded ids, those of hands and arms negative."""
        recorded = self._pictures("mask", clip).astype(np.int32)
        ids = np.where(recorded > 0, recorded + IDS_A_STEP * (state.step + 1), 0)
        for number, phrase in self._phrases().items():
            if is_hand(phrase):
                ids[recorded == number] = -number
            elif phrase in ("sky", "background"):
                ids[recorded == number] = 0
        return ids.astype(np.int32)

    def naming(self, clip: Clip, action: Action, state: SceneState) -> dict[int, str]:
        """The phrases, by the ids that `segmentation` gives."""
        first = IDS_A_STEP * (state.step + 1)
        return {first + number: p for number, p in self._phrases().items() if not is_hand(p)}

    def _phrases(self) -> dict[int, str]:
        path = self._path("mask", "txt")
        text = read_bytes(path, limit=LARGEST_TEXT).decode("utf-8", "replace")
        found = {}
        for line in text.splitlines():
            number, colon, phrase = line.partition(":")
            if not colon or not (number.strip().isascii() and number.strip().isdigit()):
                raise InputError(f"{path}: each line must be `id: phrase`, one is {quote(line)}.")
            found[int(number[:18])] = phrase.strip()
        return found

    def _frames(self, kind: str, clip: Clip, *size: int) -> Float[np.ndarray, "f ..."]:
        """The rows of an npz, one of a size for each frame of the clip."""
        path = self._path(kind, "npz")
        arrays = read_arrays(path, {}, others=("data", "inds"), packed=True)
        data, numbers, count = arrays["data"].astype(float), arrays["inds"], len(clip.frames)
        if not np.array_equal(numbers, np.arange(count)):
            raise InputError(
                f"{path} is for {numbers.size} frames, the clip has {count}: there must be one for "
                "each, in order."
            )
        if data.shape != (count, *size) or not np.isfinite(data).all():
            raise InputError(f"{path}: data is {data.shape}, not finite numbers {(count, *size)}.")
        return data

    def _pictures(self, kind: str, clip: Clip) -> np.ndarray:
        path = self._path(kind, "zip")
        count, *size = clip.frames.shape[:3]
        pictures = list(_unpack(path, count))
        if any(picture.shape != tuple(size) for picture in pictures) or len(pictures) != count:
            shapes = {picture.shape for picture in pictures} or "no"
            raise InputError(
                f"{path} holds {len(pictures)} frames of {shapes} pixels, the clip {count} of "
                f"{tuple(size)}."
            )
        return np.stack(pictures)

    def _path(self, kind: str, ending: str) -> Path:
        path = self.folder / kind / f"{self.name}.{ending}"
        if not path.is_file():
            raise InputError(f"{path} is not there: the recorded perception of a clip needs it.")
        return path


def _unpack(path: Path, most: int) -> Iterator[np.ndarray]:
    """The pictures of an archive, in the order of their names, and at most one too many."""
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            for entry in sorted(archive.infolist(), key=lambda entry: entry.filename)[: most + 1]:
                name = quote_text(entry.filename)
                if entry.file_size > LARGEST_BYTES:
                    raise InputError(f"{path}: {name} unpacks to {entry.file_size} bytes.")
                read = _exr if entry.filename.endswith(".exr") else _png
                yield read(archive.read(entry), f"{path}: {name}")
    except DAMAGE as error:
        raise InputError(f"{path} is damaged: {quote_text(str(error))}.") from error


def _png(data: bytes, name: str) -> np.ndarray:
    import cv2

    width, height = int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    picture = None
    if data.startswith(b"\x89PNG\r\n\x1a\n") and width * height <= LARGEST_PIXELS:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 2:
        raise InputError(
            f"{name} must be a PNG of one channel and at most {LARGEST_PIXELS} pixels."
        )
    return picture


def _exr(data: bytes, name: str) -> np.ndarray:
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError(
            "Recorded depth is in OpenEXR files: pip install 'egosim-jax[recorded]'."
        ) from error
    import tempfile

    with tempfile.NamedTemporaryFile(suffix=".exr") as file:  # it reads nothing but files
        file.write(data)
        file.flush()
        try:
            with OpenEXR.File(file.name, header_only=True) as header:
                first, last = header.header()["dataWindow"]
            if np.prod(np.asarray(last, float) - first + 1) > LARGEST_PIXELS:
                raise InputError(f"{name} has more than {LARGEST_PIXELS} pixels.")
            with OpenEXR.File(file.name) as picture:
                return picture.channels()["Z"].pixels.astype(np.float32)
        except (RuntimeError, KeyError, ValueError) as error:
            why = quote_text(str(error))
            raise InputError(f"{name} is no OpenEXR picture of a channel Z: {why}.") from error
