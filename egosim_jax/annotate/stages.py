"""First stages of an annotation: hands, silhouettes, cameras, lens and depth (then `scene`).

    hands -> silhouettes -> cameras -> lens -> depth -> scale -> objects -> contact -> plate
    -> scene -> caption

A stage is a function of the record so far, the estimators and the configuration. It returns the
record with additional fields, and notes on its choices and their reasons. Recorded cameras, hands,
depth and captions take precedence over estimates. A clip without cameras is refused: nothing is
guessed silently.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from einops import rearrange

from egosim_jax.annotate.captions import SIDES
from egosim_jax.annotate.config import AnnotateConfig, Estimators
from egosim_jax.annotate.frames import read_searched_frames
from egosim_jax.annotate.hand_tracks import (
    MAX_BOTH,
    before_entry,
    drop_flashes,
    hold_hands,
    on_side,
    share_of_both,
    visible,
    without,
)
from egosim_jax.annotate.prepare import RefusedError
from egosim_jax.annotate.record import Record
from egosim_jax.geometry import invert, project, transform
from egosim_jax.io.bounded import unlike
from egosim_jax.perception.video.estimates import (
    CameraEstimate,
    DepthEstimate,
    HandTracks,
    SparsePoints,
    Verdict,
)
from egosim_jax.types import Cameras, InputError

MAX_MIRRORED = 0.35
"""Maximum fraction of a hand's frames in which its joints look like the other side's."""
KEY_FRAMES = 6
"""Number of frames in a fused scene."""
HAND_PHRASES = ("hand", "arm")
"""Names of hands and arms for a segmentation network."""
Run = Callable[[Record, Estimators, AnnotateConfig], Record]


@dataclass(frozen=True)
class Stage:
    """One step of an annotation."""

    name: str
    """Name of the stage and of its file."""
    run: Run
    """Function that adds fields to the record."""
    stored: tuple[str, ...] = ()
    """Fields to store; an interrupted clip resumes after this stage."""


def find_hands(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Add `hands`. Raises `RefusedError` if too few frames show a hand."""
    recorded_m = record.recording.joints_m
    if recorded_m is not None and record.recording.kind == "human":
        hands, source = _project_given(record, recorded_m), "recording"
    elif recorded_m is not None:
        return record.add("hands", {"source": "recording", "kind": record.recording.kind})
    else:
        tracks = drop_flashes(search_hands(record, estimators), record.fps)
        hands, source = on_side(tracks, config.side), "estimated"
    seen = visible(hands)
    shown = int(np.any(seen, axis=1).sum())
    share = shown / len(seen)
    notes = {
        "source": source,
        "side": config.side,
        "frames": {side: int(seen[:, n].sum()) for n, side in enumerate(SIDES)},
        "visible": share,
    }
    if hands.mirrored is not None:
        notes["mirrored"] = {side: int(hands.mirrored[:, n].sum()) for n, side in enumerate(SIDES)}
    limit = config.cutting.quality.min_hands
    if share < limit:
        raise RefusedError(
            "hands",
            f"hands: visible in {shown} of {len(seen)} frames, less than "
            f"{limit:.0%}. {config.cutting.advice('that show hands')}A lower limit allows fewer. "
            "(--min-hands)",
            {"visible": share},
        )
    _check_sides(hands, seen, config)
    return record.add("hands", notes, hands=hands)


def search_hands(record: Record, estimators: Estimators) -> HandTracks:
    """Return the hands in pixels of the clip, searched in the video's frames if they are larger.

    A hand with less than half of its joints inside of the clip's crop is missing.
    """
    frames = read_searched_frames(record.recording, record.source_frames, record.plan)
    if frames is None:
        return estimators.hands(record.frames)
    tracks = estimators.hands(frames)
    joints_px = record.plan.pixels(tracks.joints_px, (frames.shape[1], frames.shape[2]))
    last = np.array([record.plan.width, record.plan.height]) - 0.5
    inside = ((joints_px >= -0.5) & (joints_px <= last)).all(axis=-1).mean(axis=-1) >= 0.5
    return without(replace(tracks, joints_px=joints_px), visible(tracks) & ~inside)


def _check_sides(hands: HandTracks, seen: np.ndarray, config: AnnotateConfig) -> None:
    """Raise `RefusedError` if the side of a hand is often ambiguous and was not given."""
    if hands.mirrored is None or config.side != "auto":
        return
    shares = hands.mirrored.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    if (worst := float(shares.max())) > MAX_MIRRORED:
        raise RefusedError(
            "hands",
            f"hands: the {SIDES[int(shares.argmax())]} hand has the joints of the other side in "
            f"{unlike(100 * worst, 100 * MAX_MIRRORED, '.0f')}% of its frames, more than "
            f"{MAX_MIRRORED:.0%}: its fingers are hidden. "
            + (
                f"{config.cutting.advice('in which they are visible')}Shorter clips may show them. "
                "(--num-frames)"
                if share_of_both(seen) > MAX_BOTH
                else "Give the side if there is one hand. (--side)"
            ),
            {"mirrored": worst},
        )


def draw_silhouettes(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Add `object_ids` and `names`: hands and arms, and with a network also objects."""
    if estimators.segmenter is not None:
        phrases = config.phrases or record.recording.names
        if not phrases and estimators.captioner is not None:
            phrases = estimators.captioner(record.frames)[1]
        asked = tuple(dict.fromkeys((*phrases, *HAND_PHRASES)))
        ids, names = estimators.segmenter(record.frames, asked, record.hands)
        return record.add(
            "silhouettes",
            {"masks": config.masks, "phrases": list(asked)},
            object_ids=ids.astype(np.int32),
            names={number: name for number, name in names.items() if number > 0},
        )
    if record.hands is None:
        from egosim_jax.perception.video.silhouettes import HandShape, hand_silhouette

        kind, cameras = record.recording.kind, _cameras_of_given_hands(record)
        joints = np.asarray(record.recording.joints_m)[record.source_frames]
        moving = hand_silhouette(joints, kind, cameras, HandShape()) >= 0
    else:
        from egosim_jax.perception.video.silhouettes import track_silhouettes

        held = hold_hands(record.hands, record.fps)
        absent = before_entry(record.hands, record.frames)
        moving = track_silhouettes(record.frames, without(held, absent))
    ids = np.where(moving, -1, 0).astype(np.int32)
    return record.add("silhouettes", {"masks": "geometry"}, object_ids=ids, names={})


def find_cameras(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Add `estimate`: recorded or estimated cameras. Raises `RefusedError` without cameras."""
    from egosim_jax.perception.video.cameras import CameraLadder
    from egosim_jax.perception.video.depth.triangulate import triangulate_frames

    given = _given_cameras(record)
    if given is not None:
        verdict = Verdict(rung="given", reason="given by the recording", figures={})
        estimate = CameraEstimate(
            cameras=given,
            metric=record.recording.metric,
            verdict=verdict,
            points=_given_points(record)
            or triangulate_frames(
                record.frames, record.moving, given, depth_frames(record, config)
            ),
        )
        return record.add("cameras", _camera_notes(estimate, "recording"), estimate=estimate)
    focal, source, estimator = record.device_focal_px, "estimated", estimators.cameras
    if config.focal_px is not None:
        focal, source = config.focal_px * record.plan.scale, "--focal"
    elif record.intrinsics is not None:
        focal, source = float(record.intrinsics[0, 0]), "recording"
    if source != "estimated" and isinstance(estimator, CameraLadder):
        estimator = replace(estimator, focal_px=focal)  # exact; the argument below is a guess
    estimate = estimator(record.frames, record.moving, focal_px=focal)
    if estimate.cameras is None:
        verdict = estimate.verdict
        raise RefusedError("cameras", f"cameras: {verdict.reason}", verdict.figures)
    if f"{estimate.verdict.rung}_assumed_view_deg" in estimate.verdict.figures:
        source = "assumed"
    return record.add("cameras", _camera_notes(estimate, source), estimate=estimate)


def undistort_clip(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Undistort frames, hands and silhouettes if the lens is not a pinhole."""
    from egosim_jax.perception.video.cameras import undistort, undistort_pixels

    estimate, hands = record.require("estimate"), record.hands
    if estimate.lens is None:
        return record.add("lens", {"radial": 0.0})
    if hands is not None:
        hands = replace(hands, joints_px=undistort_pixels(hands.joints_px, estimate))
    ids = undistort(record.require("object_ids").astype(np.int16), estimate)
    return record.add(
        "lens",
        asdict(estimate.lens),
        frames=undistort(record.frames, estimate),
        hands=hands,
        object_ids=ids.astype(np.int32),
    )


def find_depth(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Add `depth` of the first frame or, for a fused scene, of all key frames."""
    wanted = depth_frames(record, config)
    maps = [_given_depth(record, frame) for frame in wanted]
    if all(depth is not None for depth in maps):
        _check_unit(record)
        measured = np.stack([depth for depth in maps if depth is not None])
        depth = DepthEstimate(
            frames=np.array(wanted, np.int32),
            depth_m=measured,
            confident=np.isfinite(measured),
            metric=True,
        )
        return record.add("depth", {"source": "recording"}, depth=depth)
    depth = estimators.depth(record.frames, record.moving, record.require("estimate"), wanted)
    confident = float(depth.confident.mean())
    notes = {"source": config.depth, "reason": depth.reason, "confident": confident}
    return record.add("depth", notes, depth=depth)


def _check_unit(record: Record) -> None:
    """Raise `RefusedError` if recorded depth contradicts the distance of the hands."""
    from egosim_jax.perception.video.scale import check_depth_unit

    joints = _joints_in_cameras(record)
    shown = np.flatnonzero(np.any(np.isfinite(joints).all(axis=(2, 3)), axis=1))
    frames = shown[np.unique(np.linspace(0, len(shown) - 1, KEY_FRAMES).astype(int))]
    maps = {frame: _given_depth(record, frame) for frame in frames.tolist()} if len(shown) else {}
    measured = {frame: depth for frame, depth in maps.items() if depth is not None}
    try:
        if measured:
            check_depth_unit(record.cameras, np.stack([*measured.values()]), joints[[*measured]])
    except InputError as error:
        raise RefusedError(
            "depth", f"depth: {error} Give the length of a unit in meters. (--depth-unit)"
        ) from error


def depth_frames(record: Record, config: AnnotateConfig) -> list[int]:
    """Return the frames with depth: the first one or, for a fused scene, the key frames."""
    if config.state == "first":
        return [0]
    return sorted({int(k) for k in np.linspace(0, len(record.frames) - 1, KEY_FRAMES)})


def _given_cameras(record: Record) -> Cameras | None:
    """Return the recording's cameras at the clip's frame rate and size, if it has any."""
    given, intrinsics = record.recording.world_from_camera, record.intrinsics
    if given is None or intrinsics is None:
        return None
    return Cameras(
        world_from_camera=np.asarray(given, float)[record.source_frames],
        intrinsics_px=intrinsics,
        height=record.plan.height,
        width=record.plan.width,
    )


def _cameras_of_given_hands(record: Record) -> Cameras:
    """Return the recording's cameras. Raises `InputError` if it has only hands."""
    cameras = _given_cameras(record)
    if cameras is None:
        raise InputError(
            "The recording has hands without camera poses and intrinsics: all are needed. Import "
            "it with cameras, or without hands."
        )
    return cameras


def _given_points(record: Record) -> SparsePoints | None:
    """Return the recording's points with observations in pixels of the clip, if it has any."""
    points = record.recording.points
    if points is None or points.frames is None or points.pixels_px is None:
        return None
    clip_frame = np.full(record.recording.frames, -1)
    clip_frame[record.source_frames] = np.arange(len(record.frames))
    kept = clip_frame[points.frames] >= 0
    plan, pixels = record.plan, np.asarray(points.pixels_px)[kept].astype(float)
    errors = points.error_px
    return SparsePoints(
        points_m=points.points_m.astype(float),
        error_px=np.zeros(len(points.points_m)) if errors is None else plan.scale * errors,
        frames=clip_frame[points.frames[kept]].astype(np.int32),
        indices=np.asarray(points.indices)[kept],
        pixels_px=plan.pixels(pixels, plan.source_size),
    )


def _given_depth(record: Record, frame: int) -> np.ndarray | None:
    """Return the recorded depth of a clip's frame in meters, at the clip's size, if known."""
    depth = record.recording.read_depth(int(record.source_frames[frame]))
    return None if depth is None else record.plan.fit_depth(depth)


def _project_given(record: Record, joints_m: np.ndarray) -> HandTracks:
    """Return the recording's joints as tracks in pixels of the clip."""
    cameras = _cameras_of_given_hands(record)
    joints = joints_m[record.source_frames][:, :2]
    local = transform(rearrange(invert(cameras.world_from_camera), "f a b -> f 1 a b"), joints)
    pixels = np.stack(project(cameras.intrinsics_px, local), axis=-1)
    behind = (local[..., 2] <= 0).any(axis=-1)
    local[behind], pixels[behind] = np.nan, np.nan
    visible_hands = np.isfinite(local).all(axis=(2, 3))
    padding = ((0, 0), (0, 2 - joints.shape[1]), (0, 0), (0, 0))
    return HandTracks(
        joints_px=np.pad(pixels, padding, constant_values=np.nan),
        joints_hand_m=np.pad(local, padding, constant_values=np.nan),
        presence=np.pad(visible_hands.astype(float), padding[:2]),
    )


def _camera_notes(estimate: CameraEstimate, focal_source: str) -> dict[str, Any]:
    focal = None if estimate.cameras is None else float(estimate.cameras.intrinsics_px[0, 0])
    return {
        "rung": estimate.verdict.rung,
        "reason": estimate.verdict.reason,
        "figures": dict(estimate.verdict.figures),
        "focal_px": focal,
        "focal_source": focal_source,
        "metric": estimate.metric,
    }


def joints_in_world(record: Record) -> np.ndarray:
    """Return the world joints in meters: recorded, or lifted from pixels."""
    recorded_m = record.recording.joints_m
    if recorded_m is not None:
        return recorded_m[record.source_frames].astype(float)
    poses = rearrange(record.cameras.world_from_camera, "f a b -> f 1 a b")
    return transform(poses, _joints_in_cameras(record))


def _joints_in_cameras(record: Record) -> np.ndarray:
    """Return the joints in meters in the camera of each frame: recorded, or lifted from pixels."""
    recorded_m = record.recording.joints_m
    if recorded_m is None:
        return lifted_hands(record)
    poses = rearrange(invert(record.cameras.world_from_camera), "f a b -> f 1 a b")
    return transform(poses, recorded_m[record.source_frames].astype(float))


def lifted_hands(record: Record) -> np.ndarray:
    """Return the detected hands in meters, in the camera of each frame."""
    from egosim_jax.perception.video.hands import lift, steady

    return steady(lift(record.require("hands"), record.cameras.intrinsics_px), record.fps)
