"""Record of one clip, to which every stage adds results, and their storage as npz.

Every stage reads the record and returns it with additional fields, as in `perception.pipeline`.
Expensive fields are stored by name: arrays directly, nested dataclasses by dotted names, object ids
with run-length encoding, and all other values as JSON. Nothing is pickled.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, Int, Int32, UInt8

from egosim_jax.annotate.frames import Plan
from egosim_jax.data.recording import Recording
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import parse_json, quote_path, quote_text
from egosim_jax.io.untrusted.npz import DAMAGE, array_names, read_arrays
from egosim_jax.perception.video.estimates import (
    CameraEstimate,
    DepthEstimate,
    HandTracks,
    Lens,
    SparsePoints,
    Verdict,
)
from egosim_jax.types import Cameras, InputError, SceneState
from egosim_jax.types.arrays import Masks, Matrix

_CLASSES = {
    "hands": HandTracks,
    "estimate": CameraEstimate,
    "estimate.cameras": Cameras,
    "estimate.verdict": Verdict,
    "estimate.points": SparsePoints,
    "estimate.lens": Lens,
    "depth": DepthEstimate,
}
"""Dataclass of each dotted field name."""
_RUNS = "object_ids"


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Record:
    """Results of the stages for one clip; None before the stage has run."""

    video_id: str
    """Unique id of the clip."""
    recording: Recording
    """Recorded data of this segment, at the video's frame rate."""
    plan: Plan
    """Frame rate and crop of the clip."""
    frames: UInt8[np.ndarray, "f h w 3"]
    """Frames of the clip."""
    source_frames: Int[np.ndarray, " f"]
    """Number of each frame in the recording."""
    device_focal_px: float | None = None
    """Focal length in pixels of the clip, estimated from other clips of the video."""
    hands: HandTracks | None = None
    """Detected or recorded hands, in pixels."""
    object_ids: Int32[np.ndarray, "f h w"] | None = None
    """Object instance of each pixel: 0 background, negative for hands and arms."""
    names: Mapping[int, str] | None = None
    """Names of object instances."""
    moved_ids: Int[np.ndarray, " n"] | None = None
    """Object instances that hands move."""
    contacts: Int[np.ndarray, "c 3"] | None = None
    """Frame, side of the hand and object where a hand touches an object to move it."""
    estimate: CameraEstimate | None = None
    """Cameras and the verdict about them; in meters after the stage `scale`."""
    depth: DepthEstimate | None = None
    """Depth of the first and maybe other frames; in meters after the stage `scale`."""
    joints_m: Float[np.ndarray, "f n j 3"] | None = None
    """Joints in the world in meters."""
    first_frame: UInt8[np.ndarray, "h w 3"] | None = None
    """First frame without hands."""
    state: SceneState | None = None
    """3D scene of the clip, without hands."""
    prompt: str | None = None
    """Caption of the clip."""
    notes: Mapping[str, Any] = field(default_factory=dict)
    """Choices, figures and warnings of each stage, for annotation.json."""

    def require(self, name: str) -> Any:
        """Return a field. Raises `InputError` if no stage has set it."""
        value = getattr(self, name)
        if value is None:
            raise InputError(f"{name} is missing: no stage before this one sets it.")
        return value

    @property
    def cameras(self) -> Cameras:
        """Cameras, after the stage `cameras`."""
        return self.require("estimate").cameras

    @property
    def moving(self) -> Masks:
        """Pixels of hands and arms."""
        return self.require("object_ids") < 0

    @property
    def moved(self) -> Masks:
        """Pixels of objects that hands move, after the stage `objects`."""
        return np.isin(self.require("object_ids"), self.require("moved_ids"))

    @property
    def intrinsics(self) -> Matrix | None:
        """Intrinsics of the clip in pixels, if the recording has them."""
        given = self.recording.intrinsics_px
        return None if given is None else self.plan.intrinsics(given)

    @property
    def fps(self) -> Fraction:
        """Frame rate of the clip in frames per second."""
        return self.plan.fps

    def add(self, stage: str, notes: Mapping[str, Any], **fields: Any) -> Record:
        """Return the record with a stage's fields and notes."""
        return replace(self, notes={**self.notes, stage: dict(notes)}, **fields)


def save(path: Path, record: Record, fields: Sequence[str], stage: str) -> None:
    """Write the given fields and the notes of a stage atomically."""
    arrays: dict[str, np.ndarray] = {}
    about: dict[str, Any] = {"notes": record.notes.get(stage, {})}
    for name in fields:
        value = getattr(record, name)
        if name == _RUNS:
            arrays |= _encode_runs(value)
        else:
            _flatten(name, value, arrays, about)
    text = json.dumps(about, default=_number)
    with atomic_write(path) as temporary:
        np.savez(temporary, about=np.frombuffer(text.encode(), np.uint8), **arrays)  # pyright: ignore[reportArgumentType]


def load(path: Path, record: Record, fields: Sequence[str], stage: str) -> Record:
    """Return the record with the fields and notes in a file written by `save`.

    Raises `InputError` if the file is damaged.
    """
    try:
        arrays = read_arrays(path, {}, others=array_names(path))
        about = parse_json(arrays.pop("about").tobytes(), source=quote_path(path))
        arrays_of_stage = {
            name: _decode_runs(arrays) if name == _RUNS else _build(name, arrays, about)
            for name in fields
        }
    except (*DAMAGE, KeyError, TypeError) as error:
        raise InputError(
            f"{quote_path(path)} is damaged: {quote_text(str(error))}. Remove it."
        ) from error
    return record.add(stage, about["notes"], **arrays_of_stage)


def _number(value: Any) -> Any:
    """Return a value for JSON: a NumPy number as a Python number, others as text."""
    if isinstance(value, np.generic):
        return value.item()
    return str(value)


def _flatten(name: str, value: Any, arrays: dict[str, np.ndarray], about: dict[str, Any]) -> None:
    if isinstance(value, np.ndarray):
        arrays[name] = value
    elif name in _CLASSES and value is not None:
        about[name] = {}
        for field in dataclasses.fields(value):
            _flatten(f"{name}.{field.name}", getattr(value, field.name), arrays, about)
    elif isinstance(value, Mapping):
        about[name] = [[key, item] for key, item in value.items()]
    else:
        about[name] = value


def _build(name: str, arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> Any:
    if name in arrays:
        return arrays[name]
    value = about[name]
    if name in _CLASSES and value is not None:
        kind = _CLASSES[name]
        parts = (field.name for field in dataclasses.fields(kind))
        return kind(**{field: _build(f"{name}.{field}", arrays, about) for field in parts})
    if isinstance(value, list):
        return {key: item for key, item in value}
    return value


def _encode_runs(ids: np.ndarray) -> dict[str, np.ndarray]:
    flat = ids.reshape(-1)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(flat)) + 1])
    return {
        "runs.starts": starts,
        "runs.values": flat[starts],
        "runs.shape": np.array(ids.shape),
    }


def _decode_runs(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    starts, shape = arrays["runs.starts"], arrays["runs.shape"]
    lengths = np.diff(np.append(starts, np.prod(shape)))
    return np.repeat(arrays["runs.values"], lengths).reshape(shape).astype(np.int32)
