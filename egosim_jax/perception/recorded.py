"""Perception that was done elsewhere: the files that the official pipeline writes.

    pose/NAME.npz         data `f 4 4`, camera to world, OpenCV axes; inds `f`, the frames
    intrinsics/NAME.npz   data `f 4`, fx fy cx cy in pixels; inds `f`
    depth/NAME.zip        00000.exr ..., half floats, channel Z, metres; 0 or NaN is unknown
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

from egosim_jax.perception import Backends
from egosim_jax.state.align import CameraMethod, align_cameras
from egosim_jax.state.filter import is_hand
from egosim_jax.types import Action, Cameras, Clip, InputError, SceneState

IDS_A_STEP = 1000
"""Ids of one clip mean nothing in the next: each step has numbers of its own."""
LARGEST_BYTES = 2**28
"""Of one unpacked frame."""


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
        there = self._frames("pose", clip)
        motion = align_cameras(there, action.cameras.world_from_camera, method=self.alignment)
        scale = np.cbrt(np.linalg.det(motion[:3, :3]))
        poses = motion @ there
        poses[:, :3, :3] /= scale
        fx, fy, cx, cy = self._frames("intrinsics", clip).mean(axis=0)
        return Cameras(
            world_from_camera=poses,
            intrinsics_px=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            height=clip.frames.shape[1],
            width=clip.frames.shape[2],
        )

    def depth(self, clip: Clip, action: Action, state: SceneState) -> Float32[np.ndarray, "f h w"]:
        """The recorded depth in metres of the world; infinite where it is 0 or NaN."""
        there = self._frames("pose", clip)
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
        found = {}
        for line in path.read_text(encoding="utf-8").splitlines():
            number, colon, phrase = line.partition(":")
            if not colon or not number.strip().isdigit():
                raise InputError(f"{path}: each line must be `id: phrase`, and one is {line!r}.")
            found[int(number)] = phrase.strip()
        return found

    def _frames(self, kind: str, clip: Clip) -> Float[np.ndarray, "f ..."]:
        """The rows of an npz, one for each frame of the clip."""
        path = self._path(kind, "npz")
        try:
            with np.load(path, allow_pickle=False) as file:
                data, numbers = file["data"].astype(float), file["inds"]
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"{path} must hold `data` and `inds`: {error}.") from error
        if not np.array_equal(numbers, np.arange(len(clip.frames))):
            raise InputError(
                f"{path} is for {len(numbers)} frames, the clip has {len(clip.frames)}: there must "
                "be one for each, in order."
            )
        return data

    def _pictures(self, kind: str, clip: Clip) -> np.ndarray:
        path = self._path(kind, "zip")
        pictures = list(_unpack(path))
        if len(pictures) != len(clip.frames) or pictures[0].shape != clip.frames.shape[1:3]:
            shape = pictures[0].shape if pictures else "no"
            raise InputError(
                f"{path} holds {len(pictures)} frames of {shape} pixels, the clip "
                f"{len(clip.frames)} of {clip.frames.shape[1:3]}."
            )
        return np.stack(pictures)

    def _path(self, kind: str, ending: str) -> Path:
        path = self.folder / kind / f"{self.name}.{ending}"
        if not path.is_file():
            raise InputError(f"{path} is not there: the recorded perception of a clip needs it.")
        return path


def _unpack(path: Path) -> Iterator[np.ndarray]:
    """The pictures of an archive, in the order of their names."""
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in sorted(archive.infolist(), key=lambda entry: entry.filename):
                if entry.file_size > LARGEST_BYTES:
                    raise InputError(f"{path}: {entry.filename} unpacks to {entry.file_size} bytes")
                data = archive.read(entry)
                yield _exr(data) if entry.filename.endswith(".exr") else _png(data, path)
    except zipfile.BadZipFile as error:
        raise InputError(f"{path} is damaged: {error}.") from error


def _png(data: bytes, path: Path) -> np.ndarray:
    import cv2

    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 2:
        raise InputError(f"{path} must hold pictures of one channel.")
    return picture


def _exr(data: bytes) -> np.ndarray:
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
        with OpenEXR.File(file.name) as picture:
            return picture.channels()["Z"].pixels.astype(np.float32)
