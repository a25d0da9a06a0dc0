"""HOT3D clips: tar files of five seconds from Aria or Quest 3, with cameras and both hands.

    <n>.image_<stream>.jpg      images; stream 214-1 is Aria's color camera
    <n>.cameras.json            per stream: T_world_from_camera, and calibration of a fisheye624
    <n>.hands.json              per side: umetrack_pose with joint_angles and T_world_from_wrist
    <n>.info.json               timestamps in nanoseconds
    __hand_shapes.json__        UmeTrack's model of the wearer's hands

Transforms are quaternions w x y z and translations in meters; camera axes are OpenCV's, pixel
centers at integers. The fisheye is remapped to a pinhole. Aria's color camera is mounted sideways:
its images and camera axes are rotated clockwise by 90 degrees. Hands are computed from UmeTrack's
model (`umetrack`), not from MANO's parameters. Clips without a hand shape, such as the test clips,
have no hands. Followed: facebookresearch/hot3d, `clip_util.py`, of 2025.
"""

from __future__ import annotations

import re
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import tyro

from egosim_jax.data.readers import Entry, find_files, make_id
from egosim_jax.data.readers.hands import with_joints
from egosim_jax.data.readers.images import write_recording
from egosim_jax.data.readers.lenses import Lens, Remap
from egosim_jax.data.readers.rotations import make_poses
from egosim_jax.data.readers.umetrack import FINGERS, HINGES, HandModel
from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import (
    open_regular,
    parse_json,
    quote,
    quote_path,
    quote_text,
    refusing,
)
from egosim_jax.io.images import decode_image
from egosim_jax.io.timing import row_times
from egosim_jax.types import InputError

COLOR = "214-1"
"""Stream of Aria's color camera."""
SIDES = ("left", "right")
MAX_MEMBERS = 100_000
"""Maximum number of files in a clip."""
MAX_MEMBER_BYTES = 1 << 26
"""Maximum size of a file in a clip, in bytes."""
MAX_DRIFT_PX = 1.0
"""Maximum change of the calibration during a clip, in pixels."""
CLOCKWISE = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
"""Rotation `original_from_rotated` of the camera axes."""
_FRAME = re.compile(r"(\d{1,9})\.cameras\.json")


@dataclass(frozen=True, kw_only=True)
class Hot3D:
    """HOT3D clips of Aria or Quest 3: images, cameras and hands."""

    dataset: ClassVar[str] = "hot3d"
    source: Annotated[Path, tyro.conf.Positional]
    """Folder of clips, or one .tar file."""
    stream: str = COLOR
    """Stream to read; Quest 3 has only the gray streams 1201-1 and 1201-2."""

    def find(self) -> Iterator[Entry]:
        """Yield the clips of a HOT3D folder."""
        root = self.source if self.source.is_dir() else self.source.parent
        for path in find_files(self.source, "*.tar", kind="clip of HOT3D"):
            yield Entry(
                recording_id=make_id(path.relative_to(root).with_suffix("").parts),
                read=partial(self._read, path),
                source=path,
                options={"--stream": self.stream},
            )

    def _read(self, path: Path, folder: Path) -> Recording:
        with _open_clip(path) as clip:
            keys = sorted(match[1] for name in clip.names if (match := _FRAME.fullmatch(name)))
            if not keys:
                raise InputError(
                    f"{quote_path(path)} has no <n>.cameras.json: it is not a HOT3D clip."
                )
            cameras = [clip.camera(key, self.stream) for key in keys]
            picked, fps = clip.moments(keys, self.stream)
            keys, cameras = [keys[n] for n in picked], [cameras[n] for n in picked]
            lens = _lens([calibration for calibration, _ in cameras], clip.name)
            remap = Remap.of(lens)
            poses = np.concatenate([pose for _, pose in cameras])
            turned = self.stream == COLOR
            images = remap.apply(clip.image(f"{key}.image_{self.stream}.jpg") for key in keys)
            frames = (np.rot90(image, -1) for image in images) if turned else images
            recording = write_recording(folder, frames, fps)
            joints = clip.hands(keys)
        intrinsics = remap.intrinsics_px.copy()
        if turned:
            poses[:, :3, :3] = poses[:, :3, :3] @ CLOCKWISE
            (fx, _, cx), (_, fy, cy), _ = intrinsics.tolist()
            intrinsics = np.array([[fy, 0, lens.height - 1 - cy], [0, fx, cx], [0, 0, 1]])
        recording = replace(
            recording,
            world_from_camera=poses,
            intrinsics_px=intrinsics,
            metric=True,
            provenance={"turned": "clockwise" if turned else "no"},
        )
        return with_joints(recording, joints)


class _Clip:
    """An open tar file of a clip."""

    def __init__(self, tar: tarfile.TarFile, name: str):
        self.name = name
        members = []
        with refusing(f"{name} is not a readable tar file"):
            for member in tar:
                member.pax_headers = {}  # each has a copy of the file's global header
                members.append(member)
                if len(members) > MAX_MEMBERS:
                    raise InputError(f"{name} has more files than the maximum, {MAX_MEMBERS:,}.")
        self._tar = tar
        self.names = {m.name: m for m in members if m.isreg() and not m.issparse()}

    def read(self, name: str) -> bytes:
        """Return the bytes of a file."""
        member = self.names.get(name)
        if not member or member.size > MAX_MEMBER_BYTES:
            why = "is too large" if member else "is missing"
            raise InputError(f"{self.name}: {quote_text(name)} {why}.")
        with refusing(f"{self.name}: {quote_text(name)} cannot be read"):
            file = self._tar.extractfile(member)
            return file.read() if file else b""

    def json(self, name: str) -> Any:
        """Return the object in a JSON file."""
        value = parse_json(self.read(name), source=f"{self.name}: {name}", limit=MAX_MEMBER_BYTES)
        if not isinstance(value, dict):
            raise InputError(f"{self.name}: {name} is not a JSON object.")
        return value

    def image(self, name: str) -> np.ndarray:
        """Decode an image."""
        return decode_image(self.read(name), name=f"{self.name}: {name}", pixels="stored")

    def camera(self, key: str, stream: str) -> tuple[dict[str, Any], np.ndarray]:
        """Return calibration and pose of a camera at a frame."""
        streams = self.json(f"{key}.cameras.json")
        camera = streams.get(stream)
        if not isinstance(camera, dict) or not isinstance(camera.get("calibration"), dict):
            raise InputError(
                f"{self.name}: frame {key} has no camera of stream {quote(stream)}; it has "
                f"{quote_text(', '.join(streams))}. (--stream)"
            )
        return camera["calibration"], self._pose(camera.get("T_world_from_camera"), key)

    def hands(self, keys: list[str]) -> np.ndarray | None:
        """Return the keypoints of both hands in the world; None if the clip has no hand shape."""
        if "__hand_shapes.json__" not in self.names:
            return None
        model = HandModel.from_json(self.json("__hand_shapes.json__").get("umetrack"))
        joints = np.full((len(keys), 2, 21, 3), np.nan)
        for frame, key in enumerate(keys):
            name = f"{key}.hands.json"
            written = self.json(name) if name in self.names else {}
            for side, label in enumerate(SIDES):
                hand = written.get(label)
                pose = hand.get("umetrack_pose") if isinstance(hand, dict) else None
                if isinstance(pose, dict):
                    angles = _numbers(pose.get("joint_angles"), FINGERS * HINGES, f"{name}: angles")
                    wrist = self._pose(pose.get("T_world_from_wrist"), key)[0]
                    joints[frame, side] = model.keypoints(angles, wrist, side)
        return joints

    def moments(self, keys: list[str], stream: str) -> tuple[list[int], Fraction]:
        """Return the frames nearest to the moments of a constant rate, and the rate."""
        stamps = []
        for key in keys:
            written = self.json(f"{key}.info.json").get("image_timestamps_ns")
            time = written.get(stream) if isinstance(written, dict) else None
            stamps.append(time / 1e9 if type(time) is int else None)
        if len([stamp for stamp in stamps if stamp is not None]) < 2:
            raise InputError(f"{self.name} has no timestamps of stream {quote(stream)}.")
        rows, _, timeline = row_times(stamps, [], f"{self.name}, image_timestamps_ns")
        if not Fraction(1, 10) <= timeline.fps <= 1000:
            raise InputError(f"{self.name}: {float(timeline.fps):g} is no frame rate.")
        moments_s = timeline.moments_s(0, timeline.count)
        return rows[timeline.nearest(moments_s)].tolist(), timeline.fps

    def _pose(self, written: Any, key: str) -> np.ndarray:
        parts = written if isinstance(written, dict) else {}
        name = f"{self.name}: transform of frame {key}"
        w, x, y, z = _numbers(parts.get("quaternion_wxyz"), 4, name)[:4]
        translation = _numbers(parts.get("translation_xyz"), 3, name)[:3]
        return make_poses(np.array([[x, y, z, w]]), translation[None])


def _numbers(value: Any, minimum: int, name: str) -> np.ndarray:
    try:
        numbers = np.array(value, float)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.ndim != 1 or not minimum <= len(numbers) <= 64 or not np.isfinite(numbers).all():
        raise InputError(f"{name} is {quote(value)}: it must be at least {minimum} finite numbers.")
    return numbers


def _lens(calibrations: list[dict[str, Any]], name: str) -> Lens:
    """Return the lens that all frames share. Raises `InputError` if the calibration changes."""
    first = calibrations[0]
    if "FISHEYE624" not in str(first.get("projection_model_type")):
        raise InputError(
            f"{name}: its camera model is {quote(first.get('projection_model_type'))}; expected "
            "FISHEYE624."
        )
    parameters = [
        _numbers(c.get("projection_params"), 15, f"{name}: projection_params") for c in calibrations
    ]
    same = all(len(p) == len(parameters[0]) for p in parameters)
    if not same or np.ptp(np.stack(parameters)[:, :3], axis=0).max() > MAX_DRIFT_PX:
        raise InputError(f"{name}: its calibration changes by more than {MAX_DRIFT_PX:g} px.")
    values = parameters[0].tolist()
    fx, fy, cx, cy, *k = values if len(values) == 16 else [values[0], *values]
    height, width = first.get("image_height"), first.get("image_width")
    if not isinstance(height, int) or not isinstance(width, int) or min(height, width) < 1:
        raise InputError(f"{name}: its image has {quote(width)} x {quote(height)} pixels.")
    return Lens(
        model="fisheye624",
        coefficients=tuple(k),
        intrinsics_px=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        height=height,
        width=width,
    )


@contextmanager
def _open_clip(path: Path) -> Iterator[_Clip]:
    name = quote_path(path)
    with open_regular(path) as file:
        with refusing(f"{name} is not a readable tar file"):
            tar = tarfile.open(fileobj=file, mode="r:")  # noqa: SIM115
        with tar:
            yield _Clip(tar, name)
