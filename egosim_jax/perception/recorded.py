"""Perception results of another pipeline, read from files in the format of EgoSim's release.

    pose/NAME.npz         data `f 4 4`, world from camera, OpenCV axes; inds `f`, the frames
    intrinsics/NAME.npz   data `f 4`, fx fy cx cy in pixels; inds `f`
    depth/NAME.zip        00000.exr ..., half floats, channel Z, meters; 0 or NaN is unknown
    mask/NAME.zip         00000.png ..., 8 bits, the object id of each pixel; 0 is background
    mask/NAME.txt         one line per object, `id: phrase`

Source: EgoSim's `continuous_simulation`, a modified ViPE; see the released `utils/io.py` and
`reconstruct_from_artifacts`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from glob import escape, glob
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from egosim_jax.io.bounded import open_regular, quote, quote_text, read_bytes
from egosim_jax.io.digest import sha256
from egosim_jax.io.images import decode_labels
from egosim_jax.io.untrusted.npz import DAMAGE, read_arrays
from egosim_jax.io.untrusted.zipped import from_file
from egosim_jax.perception.pipeline import Observation, Pipeline, find_interactions
from egosim_jax.perception.registry import register
from egosim_jax.state.align import CameraMethod, align_cameras
from egosim_jax.state.filter import is_hand
from egosim_jax.types import Action, Cameras, Clip, InputError, SceneState
from egosim_jax.types.arrays import DepthMaps, IdMaps

IDS_PER_STEP = 1000
"""Offset between the object ids of successive steps, since recorded ids repeat in each clip."""
STEP = "{step}"
"""Placeholder for the step number in the file name."""
FILES = (
    ("pose", "npz"), ("intrinsics", "npz"), ("depth", "zip"), ("mask", "zip"), ("mask", "txt"),
)  # fmt: skip
"""Folder and suffix of each file of a clip."""
MAX_FRAME_BYTES = 2**28
"""Maximum size of an unpacked frame in bytes."""
MAX_FRAME_PIXELS = 2**25
"""Maximum size of a frame in pixels."""
MAX_TEXT_BYTES = 2**20
"""Maximum size of a list of phrases in bytes."""


@register("recorded")
@dataclass(frozen=True, kw_only=True)
class RecordedConfig:
    """Perception results read from the files of one clip, or of one clip per step."""

    reads_ground_truth: ClassVar[bool] = False
    folder: Path
    """Folder with pose/, intrinsics/, depth/ and mask/."""
    name: str
    """Name of the clip's files, without suffix. {step} in it is the step number, from 1."""
    alignment: CameraMethod = "orientations"
    """Method that aligns the recorded cameras with the action's."""

    def build(self, ground_truth: Mapping[int, Observation] | None = None) -> Pipeline:
        """Return the pipeline that reads the files; the ground truth is not used."""
        stage = ReadRecording(config=self, files=self._hashes())
        return Pipeline(stages=(stage, find_interactions))

    def check_clips(self, count: int) -> None:
        """Raise `InputError` if several clips would be read from the same files."""
        if count > 1 and STEP not in self.name:
            raise InputError(
                f"recorded --name {quote_text(self.name)} names the files of one clip, but "
                f"{count} clips are simulated: the name must contain {STEP}, the step number. "
                f"Use a name such as clip_{STEP}, or --clips 1. (--perception)"
            )

    def path(self, kind: str, suffix: str, step: int | str) -> Path:
        """Return the path of a step's file."""
        return self.folder / kind / f"{self.name.replace(STEP, str(step))}.{suffix}"

    def _hashes(self) -> dict[str, str]:
        """Return the SHA-256 of each existing file, by its path in the folder."""
        config = replace(self, folder=Path(escape(str(self.folder))), name=escape(self.name))
        patterns = (str(config.path(kind, suffix, "*")) for kind, suffix in FILES)
        paths = (Path(path) for pattern in patterns for path in sorted(glob(pattern)))
        return {f"{path.parent.name}/{path.name}": sha256(path) for path in paths if path.is_file()}


@dataclass(frozen=True, kw_only=True)
class ReadRecording:
    """Stage that sets cameras, depth, object ids and names from files, each read once."""

    config: RecordedConfig
    """Location of the files."""
    files: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of each file; it enters the fingerprint of a run."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set all fields except hand joints and interactions. No object is tracked."""
        cameras, scale = self._cameras(clip, action, state.step + 1)
        phrases = self._phrases(state.step + 1)
        first_id = IDS_PER_STEP * (state.step + 1)
        return replace(
            so_far,
            cameras=cameras,
            depth_m=self._depth(clip, scale, state.step + 1),
            object_ids=self._object_ids(clip, phrases, state.step + 1),
            names={first_id + number: p for number, p in phrases.items() if not is_hand(p)},
            motions={},
        )

    def _cameras(self, clip: Clip, action: Action, step: int) -> tuple[Cameras, float]:
        """Return the recorded cameras in the world, and the scale of the alignment."""
        recorded = self._frames("pose", step, clip, 4, 4)
        alignment = align_cameras(
            recorded, action.cameras.world_from_camera, method=self.config.alignment
        )
        scale = np.cbrt(np.linalg.det(alignment[:3, :3]))
        poses = alignment @ recorded
        poses[:, :3, :3] /= scale
        fx, fy, cx, cy = self._frames("intrinsics", step, clip, 4).mean(axis=0)
        cameras = Cameras(
            world_from_camera=poses,
            intrinsics_px=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            height=clip.frames.shape[1],
            width=clip.frames.shape[2],
        )
        return cameras, scale

    def _depth(self, clip: Clip, scale: float, step: int) -> DepthMaps:
        """Return the recorded depth in meters of the world; infinite where it is 0 or NaN."""
        depth = scale * self._images("depth", step, clip)
        return np.where(depth > 0, depth, np.inf).astype(np.float32)

    def _object_ids(self, clip: Clip, phrases: Mapping[int, str], step: int) -> IdMaps:
        """Return the recorded object ids in the state's numbering; hands and arms are negative."""
        recorded = self._images("mask", step, clip).astype(np.int32)
        ids = np.where(recorded > 0, recorded + IDS_PER_STEP * step, 0)
        for number, phrase in phrases.items():
            if is_hand(phrase):
                ids[recorded == number] = -number
            elif phrase in ("sky", "background"):
                ids[recorded == number] = 0
        return ids.astype(np.int32)

    def _phrases(self, step: int) -> dict[int, str]:
        path = self._path("mask", "txt", step)
        text = read_bytes(path, limit=MAX_TEXT_BYTES).decode("utf-8-sig", "replace")
        phrases = {}
        for line in text.splitlines():
            number, colon, phrase = line.partition(":")
            if not colon or not (number.strip().isascii() and number.strip().isdigit()):
                raise InputError(f"{path}: each line must be `id: phrase`, not {quote(line)}.")
            phrases[int(number[:18])] = phrase.strip()
        return phrases

    def _frames(self, kind: str, step: int, clip: Clip, *size: int) -> Float[np.ndarray, "f ..."]:
        """Return the rows of an npz file: one of the given size for each frame of the clip."""
        path = self._path(kind, "npz", step)
        arrays = read_arrays(path, {}, others=("data", "inds"), packed=True)
        data, numbers, count = arrays["data"].astype(float), arrays["inds"], len(clip.frames)
        if not np.array_equal(numbers, np.arange(count)):
            raise InputError(
                f"{path} is for {numbers.size} frames, the clip has {count}: it must have one row "
                "per frame, in order."
            )
        if data.shape != (count, *size) or not np.isfinite(data).all():
            raise InputError(f"{path}: data is {data.shape}, not finite numbers {(count, *size)}.")
        return data

    def _images(self, kind: str, step: int, clip: Clip) -> np.ndarray:
        path = self._path(kind, "zip", step)
        count, *size = clip.frames.shape[:3]
        images = list(_unpack(path, count))
        if any(image.shape != tuple(size) for image in images) or len(images) != count:
            shapes = {image.shape for image in images} or "no"
            raise InputError(
                f"{path} holds {len(images)} frames of {shapes} pixels, the clip {count} of "
                f"{tuple(size)}."
            )
        return np.stack(images)

    def _path(self, kind: str, suffix: str, step: int) -> Path:
        path = self.config.path(kind, suffix, step)
        if not path.is_file():
            raise InputError(
                f"{path} is missing: recorded perception needs this file for each clip."
            )
        return path


def _unpack(path: Path, count: int) -> Iterator[np.ndarray]:
    """Yield the images of an archive, sorted by name, and at most one more than `count`."""
    try:
        with open_regular(path) as file:
            archive = from_file(file)
            for name in sorted(archive.entries)[: count + 1]:
                read = _exr if name.endswith(".exr") else decode_labels
                data = archive.read(name, limit=MAX_FRAME_BYTES)
                yield read(data, f"{path}: {quote_text(name)}")
    except DAMAGE as error:
        raise InputError(f"{path} is damaged: {quote_text(str(error))}.") from error


def _exr(data: bytes, name: str) -> np.ndarray:
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError(
            "Recorded depth is in OpenEXR files: pip install 'egosim-jax[recorded]'."
        ) from error
    import tempfile

    with tempfile.NamedTemporaryFile(suffix=".exr") as file:  # OpenEXR reads from files only
        file.write(data)
        file.flush()
        try:
            with OpenEXR.File(file.name, header_only=True) as header:
                first, last = header.header()["dataWindow"]
                channels = len(header.header()["channels"])
            if channels * np.prod(np.asarray(last, float) - first + 1) > MAX_FRAME_PIXELS:
                raise InputError(f"{name} has more than {MAX_FRAME_PIXELS} pixels.")
            with OpenEXR.File(file.name) as image:
                return image.channels()["Z"].pixels.astype(np.float32)
        except (RuntimeError, KeyError, ValueError) as error:
            why = quote_text(str(error))
            raise InputError(f"{name} is not an OpenEXR image with a channel Z: {why}.") from error
