"""Recordings: a segment of a video, and all that a dataset or device knows about it.

    recording.json    video and frames in it, rate, size, caption, names, depth files, provenance
    arrays.npz        where known: world_from_camera `f 4 4`, intrinsics_px `3 3`, joints_m
                      `f n j 3`, times_s `f`, and the fields of the scene's points

    {"format": "egosim_jax.recording", "version": 1, "recording_id": "fold_12",
     "video": "/data/fold/12.mp4", "start": 0, "frames": 240, "fps": "30", "height": 1080, ...
     "sha256": "9a..."}

The conventions are the project's: OpenCV axes (x right, y down, z forward), pixel centers at
integer coordinates, joints in the world of the cameras. Poses and points are in meters if `metric`,
else in an unknown unit; then there are no hands. Unknown values are None, never guessed. Paths
inside the folder are stored relative to it, all others absolute. Nothing is unpickled.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, Float32

from egosim_jax.data.clip_files import SAFE_IDS, is_safe_id
from egosim_jax.data.recorded_files import (
    DESCRIPTION,
    DepthFiles,
    found_depth,
    found_path,
    stored_path,
)
from egosim_jax.data.scene_points import ScenePoints
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import check_version, quote, quote_path, read_json
from egosim_jax.io.digest import sha256
from egosim_jax.io.images import read_depth_image
from egosim_jax.io.run import write_json
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.io.video import Video, VideoInfo, read_moments, read_video
from egosim_jax.types import (
    Action,
    Cameras,
    InputError,
    Kind,
    check_counts,
    check_hands,
    check_rigid,
    seen_hands,
)

FORMAT, VERSION = "egosim_jax.recording", 1
ARRAYS = "arrays.npz"
UNNAMED = "recording"
"""Id of a recording until an import names it."""
MAX_FRAMES = 1 << 20
"""Maximum length of a recording in frames: about ten hours."""
MAX_BYTES = 1 << 28
"""Maximum size of a description in bytes."""
MAX_STRETCH = 0.1
"""Maximum relative difference between the aspect ratios of depth and image."""
MAX_FPS = 1000
"""Maximum frame rate."""
RATE = re.compile(r"[0-9]{1,40}(?:\.[0-9]{1,40}|/[1-9][0-9]{0,39})?")
"""Frame rate in a description. No exponents: `Fraction("1e999999999")` would fill the memory."""
MAX_TEXT = 10_000
"""Maximum length of a caption, name or entry of the provenance, in characters."""
_DTYPES = {"world_from_camera": "float64", "intrinsics_px": "float64", "joints_m": "float64",
           "times_s": "float64", "points_m": "float32", "colors": "uint8", "error_px": "float32",
           "frames": "int32", "indices": "int32", "pixels_px": "float32"}  # fmt: skip
_OWN = ("world_from_camera", "intrinsics_px", "joints_m", "times_s")
"""Arrays of a recording itself; the others are its points'."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Recording:
    """A segment of a video, with its cameras, hands, scene and caption where known."""

    recording_id: str
    """Unique id, which names the outputs."""
    video: Path
    """Video file of the recording."""
    start: int = 0
    """First frame of the recording in the video."""
    times_s: Float[np.ndarray, " f"] | None = None
    """Times of the frames after the first of the video, instead of `start`; None: no gaps."""
    frames: int
    """Number of frames of the recording."""
    fps: Fraction
    """Frame rate of the recording in frames per second."""
    height: int
    """Height of a displayed frame in pixels."""
    width: int
    """Width of a displayed frame in pixels."""
    world_from_camera: Float[np.ndarray, "f 4 4"] | None = None
    """Camera poses in OpenCV axes."""
    intrinsics_px: Float[np.ndarray, "3 3"] | None = None
    """Pinhole intrinsics of all frames; None if unknown or if the lens is not a pinhole."""
    metric: bool = False
    """True if poses, joints and points are in meters; False if their unit is unknown."""
    joints_m: Float[np.ndarray, "f n j 3"] | None = None
    """Joints of n hands in the world, left before right; a missing hand is NaN."""
    kind: Kind = "human"
    """Kind of hands: human with 21 keypoints, or robot grippers with 3."""
    depth: DepthFiles | None = None
    """Measured depth of the frames."""
    points: ScenePoints | None = None
    """Points of the scene."""
    caption: str | None = None
    """Caption: a sentence about what happens in the video."""
    names: tuple[str, ...] = ()
    """Names of the manipulated objects; empty if unknown."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Dataset, files and decisions of the reader, as arbitrary key-value pairs."""

    def __post_init__(self) -> None:
        """Check all fields, without decoding the video. Raises `InputError`."""
        if not is_safe_id(self.recording_id):
            raise InputError(
                f"recording_id {quote(self.recording_id)} is not a valid file name; use {SAFE_IDS}."
            )
        counts = ("frames", "height", "width")
        check_counts({name: getattr(self, name) for name in counts})
        if self.start < 0 or self.start + self.frames > MAX_FRAMES:
            raise InputError(
                f"Frames {self.start} to {self.start + self.frames - 1} of a video: frames are "
                f"counted from 0 and must be below {MAX_FRAMES:,}. Split the video."
            )
        if not (isinstance(self.fps, Fraction) and 0 < self.fps <= MAX_FPS):
            raise InputError(
                f"fps is {quote(str(self.fps))}: it must be a fraction above 0 and at most "
                f"{MAX_FPS}."
            )
        times_s = self.times_s
        if times_s is not None and not (
            times_s.shape == (self.frames,)
            and times_s[0] >= 0
            and np.isfinite(times_s).all()
            and (np.diff(times_s) > 0).all()
        ):
            raise InputError(
                f"times_s is {times_s.shape} from {times_s[:1]} s: it must be {self.frames} "
                "increasing times in seconds, one for each frame, or None."
            )
        self._check_texts()
        self._check_cameras()
        self._check_hands()
        if self.depth is not None:
            self._check_depth(self.depth)
        seen = None if self.points is None else self.points.frames
        if seen is not None and len(seen) and not (0 <= seen.min() <= seen.max() < self.frames):
            raise InputError(
                f"Points are observed in frames {seen.min()} to {seen.max()}: the recording has "
                f"{self.frames}, counted from 0."
            )

    @classmethod
    def of_video(cls, video: Path, info: VideoInfo, **fields: Any) -> Recording:
        """Return a recording of a video: of all frames, unless `fields` say which, and unnamed."""
        size = {"frames": info.frames, "height": info.height, "width": info.width}
        return cls(**{"recording_id": UNNAMED, "video": video, "fps": info.fps, **size, **fields})

    @property
    def cameras(self) -> Cameras | None:
        """Cameras, if poses and intrinsics are known; in an unknown unit unless `metric`."""
        if self.world_from_camera is None or self.intrinsics_px is None:
            return None
        return Cameras(
            world_from_camera=self.world_from_camera,
            intrinsics_px=self.intrinsics_px,
            height=self.height,
            width=self.width,
        )

    def read_frames(
        self,
        start: int = 0,
        stop: int | None = None,
        *,
        each: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> Video:
        """Decode frames `start` to `stop` (exclusive; the end if None) of the recording.

        Raises `InputError` if a frame is missing or has another size than the recording.
        """
        stop = self.frames if stop is None else stop
        size, name = (self.height, self.width), quote_path(self.video)

        def checked(frame: np.ndarray) -> np.ndarray:
            if frame.shape[:2] != size:
                raise InputError(
                    f"{name} has frames of {frame.shape[1]}x{frame.shape[0]}: the recording says "
                    f"{self.width}x{self.height}. Import it again."
                )
            return frame if each is None else each(frame)

        if self.times_s is None:
            first, end = self.start + start, self.start + stop
            video = read_video(self.video, start=first, stop=end, whole=True, each=checked)
        else:
            video = read_moments(self.video, self.times_s[start:stop], each=checked)
        return Video(frames=video.frames, fps=self.fps)

    def read_depth(self, frame: int) -> Float32[np.ndarray, "h w"] | None:
        """Return measured depth in meters at the image's size, infinite where unknown, or None.

        A smaller map is enlarged by nearest neighbor, so that edges stay sharp. Raises `InputError`
        if its shape is not the image's.
        """
        if self.depth is None or (path := self.depth.paths[frame]) is None:
            return None
        values = read_depth_image(path) * np.float32(self.depth.unit_m)
        rows, columns = values.shape
        fitting = rows * self.width / self.height
        if abs(columns - fitting) > max(1, MAX_STRETCH * fitting):
            raise InputError(
                f"{quote_path(path)} is {columns}x{rows} and the image "
                f"{self.width}x{self.height}: depth must have the image's shape. Remove the depth "
                "files, or align them with the images."
            )
        at = [
            np.minimum((np.arange(size) + 0.5) * stored / size, stored - 1).astype(int)
            for size, stored in zip((self.height, self.width), values.shape, strict=True)
        ]
        values = values[at[0][:, None], at[1]]
        return np.where(np.isfinite(values) & (values > 0), values, np.float32(np.inf))

    def clip(self, start: int, stop: int) -> Recording:
        """Return the recording of frames `start` to `stop` (exclusive), with the same id.

        Hands that never come near the view in these frames are missing from all of them.
        """
        if not 0 <= start < stop <= self.frames:
            raise InputError(
                f"Frames {start} to {stop} of recording {self.recording_id}: it has {self.frames}, "
                "and a clip needs at least one."
            )
        poses, joints = self.world_from_camera, self.joints_m
        if joints is not None:
            joints = joints[start:stop]
        if joints is not None and self.cameras is not None:
            path = self.cameras.world_from_camera[start:stop]
            joints = seen_hands(replace(self.cameras, world_from_camera=path), joints)
        depth = self.depth and replace(self.depth, paths=self.depth.paths[start:stop])
        return replace(
            self,
            start=self.start + start if self.times_s is None else 0,
            times_s=None if self.times_s is None else self.times_s[start:stop],
            frames=stop - start,
            depth=depth,
            points=self.points and self.points.within(start, stop),
            world_from_camera=None if poses is None else poses[start:stop],
            joints_m=joints,
        )

    def save(self, folder: Path) -> None:
        """Write the two files of a recording, each atomically; replaces earlier ones."""
        folder = folder.resolve()
        arrays: dict[str, Any] = {
            name: np.ascontiguousarray(value, dtype)
            for name, dtype in _DTYPES.items()
            if (value := _array(self, name)) is not None
        }
        with atomic_write(folder / ARRAYS) as temporary:
            np.savez(temporary, **arrays)
        depth = self.depth and {
            "unit_m": self.depth.unit_m,
            "paths": [path and stored_path(path, folder) for path in self.depth.paths],
        }
        description = {
            "format": FORMAT,
            "version": VERSION,
            "recording_id": self.recording_id,
            "video": stored_path(self.video, folder),
            "start": int(self.start),
            "frames": int(self.frames),
            "fps": str(self.fps),
            "height": int(self.height),
            "width": int(self.width),
            "metric": bool(self.metric),
            "kind": self.kind,
            "caption": self.caption,
            "names": list(self.names),
            "depth": depth,
            "provenance": dict(self.provenance),
            "sha256": sha256(folder / ARRAYS),
        }
        write_json(folder / DESCRIPTION, description)

    @classmethod
    def load(cls, folder: Path) -> Recording:
        """Read a recording. Raises `InputError` if it is damaged or invalid."""
        folder = folder.resolve()
        try:
            return _load(folder)
        except InputError as error:
            raise InputError(
                f"{quote_path(folder)} is not a readable recording: {error}"
            ) from error

    def _check_texts(self) -> None:
        texts = {
            "caption": self.caption or "",
            **{f"name {number}": name for number, name in enumerate(self.names)},
            **{f"provenance {quote(key)}": value for key, value in self.provenance.items()},
        }
        for name, text in texts.items():
            if not isinstance(text, str) or len(text) > MAX_TEXT:
                raise InputError(
                    f"The {name} of a recording is {quote(text)}: it must be text of at most "
                    f"{MAX_TEXT:,} characters."
                )

    def _check_cameras(self) -> None:
        poses = self.world_from_camera
        if poses is not None:
            if np.shape(poses) != (self.frames, 4, 4) or poses.dtype.kind != "f":
                raise InputError(
                    f"world_from_camera is {getattr(poses, 'dtype', '')} {np.shape(poses)}: it "
                    f"must be floats ({self.frames}, 4, 4), one pose per frame, or None."
                )
            check_rigid(poses)
        if self.intrinsics_px is not None:
            Cameras(
                world_from_camera=np.eye(4)[None],
                intrinsics_px=self.intrinsics_px,
                height=self.height,
                width=self.width,
            )

    def _check_hands(self) -> None:
        joints, cameras = self.joints_m, self.cameras
        if joints is None:
            return
        if self.world_from_camera is None or not self.metric:
            raise InputError(
                "joints_m are given without camera poses in meters: joints are in the world of the "
                "cameras and in meters. Give poses (world_from_camera) and metric=True, or None."
            )
        if cameras is not None:
            Action(cameras=cameras, joints_m=joints, kind=self.kind, prompt="")
        else:
            check_hands(joints, self.kind, self.frames)

    def _check_depth(self, depth: DepthFiles) -> None:
        if len(depth.paths) != self.frames or not 0 < depth.unit_m < 1e3:
            raise InputError(
                f"depth has {len(depth.paths)} files of unit {depth.unit_m} m: it must have one "
                f"path or None for each of the {self.frames} frames, and a unit above 0 and below "
                "1000 m."
            )


def _array(recording: Recording, name: str) -> np.ndarray | None:
    owner = recording if name in _OWN else recording.points
    return None if owner is None else getattr(owner, name)


def _load(folder: Path) -> Recording:
    written = read_json(folder / DESCRIPTION, limit=MAX_BYTES)
    if not isinstance(written, dict) or written.get("format") != FORMAT:
        raise InputError(f"{DESCRIPTION} does not describe a recording ({FORMAT}).")
    check_version(written.get("version"), VERSION, source=DESCRIPTION)
    for name, kind in {"recording_id": str, "start": int, "frames": int, "fps": str, "height": int,
                       "width": int, "metric": bool, "kind": str, "names": list,
                       "provenance": dict}.items():  # fmt: skip
        if type(written.get(name)) is not kind:
            raise InputError(
                f"{DESCRIPTION}: {name} is {quote(written.get(name))}; expected {kind.__name__}."
            )
    if sha256(folder / ARRAYS) != written.get("sha256"):
        raise InputError(
            f"{ARRAYS} is damaged: its SHA-256 differs from the one in {DESCRIPTION}. Import it "
            "again."
        )
    arrays: dict[str, Any] = read_arrays(folder / ARRAYS, {}, optional=_DTYPES)
    points = {n: arrays.pop(n) for n in _DTYPES if n in arrays and n not in _OWN}
    if points and "points_m" not in points:
        raise InputError(f"{ARRAYS} has {', '.join(points)}, but no points_m.")
    if not RATE.fullmatch(written["fps"]):
        raise InputError(f"{DESCRIPTION}: fps is {quote(written['fps'])}, not a rate.")
    names = ("recording_id", "start", "frames", "height", "width", "metric", "kind", "caption",
             "provenance")  # fmt: skip
    return Recording(
        **{name: written.get(name) for name in names},
        **arrays,
        video=found_path(written.get("video"), folder),
        fps=Fraction(written["fps"]),
        names=tuple(written["names"]),
        depth=found_depth(written.get("depth"), folder),
        points=ScenePoints(**points) if points else None,
    )
