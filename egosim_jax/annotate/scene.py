"""Stages that make the scene of a clip: meters, first frame without hands, state, caption."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from egosim_jax.annotate.config import AnnotateConfig, Estimators
from egosim_jax.annotate.prepare import RefusedError
from egosim_jax.annotate.record import Record
from egosim_jax.annotate.stages import (
    SIDES,
    Stage,
    draw_silhouettes,
    find_cameras,
    find_depth,
    find_hands,
    joints_in_world,
    undistort_clip,
    visible,
)
from egosim_jax.evaluation.metrics.image import decibels
from egosim_jax.geometry import invert, pixel_rays, pixels_of, transform
from egosim_jax.perception.estimates import DepthEstimate, Rung
from egosim_jax.rendering.reference import splat
from egosim_jax.state.depth import state_from_depth
from egosim_jax.types import SceneState, Triplet

PLATE_MARGIN = 1 / 80
"""Width in images of the border around drawn hands that is replaced, too."""
FRAMES_AT_ONCE = 64
"""Frames that are rendered together."""
POINT_PX = 2
"""Size in pixels of the points of a prior."""


def find_scale(record: Record, parts: Estimators, config: AnnotateConfig) -> Record:
    """Bring cameras, depth and joints to meters; note the scale, its source and uncertainty."""
    from egosim_jax.perception.hands import lift
    from egosim_jax.perception.scale import Scale, estimate_scale, scale_cameras, scale_depth

    estimate, depth = record.require("estimate"), record.require("depth")
    joints = None if record.hands is None else lift(record.hands, record.cameras.intrinsics_px)
    still = depth.metric and not estimate.metric and estimate.points is None
    if still and config.scale is None:
        scale = Scale(
            meters_per_unit=1.0,
            uncertainty=0.0,
            source="metric depth",
            reason="depth is in meters, and the camera stays in its place",
        )
    else:
        moved = depth.metric and not estimate.metric and estimate.points is not None
        scale = estimate_scale(
            estimate,
            _sparse_depth(record) if moved else depth,
            joints,
            record.moving,
            meters_per_unit=config.scale,
            camera_height_m=config.camera_height_m,
            metric_depth=depth if moved else None,
        )
    record = record.add(
        "scale", asdict(scale),
        estimate=scale_cameras(estimate, scale), depth=scale_depth(depth, scale),
    )  # fmt: skip
    return replace(record, joints_m=joints_in_world(record))


def _sparse_depth(record: Record) -> DepthEstimate:
    """Return the triangulated points as depth of the first frame, in the unit of the cameras."""
    estimate = record.require("estimate")
    points, cameras = estimate.points, estimate.cameras
    own = points.frames == 0
    local = transform(invert(cameras.world_from_camera[0]), points.points_m[points.indices[own]])
    row, column, inside = pixels_of(cameras, local)
    sparse = np.full((1, cameras.height, cameras.width), np.inf, np.float32)
    sparse[0, row[inside], column[inside]] = local[inside, 2]
    return DepthEstimate(
        frames=np.zeros(1, np.int32), depth_m=sparse, confident=np.isfinite(sparse), metric=False
    )


def clean_first_frame(record: Record, parts: Estimators, config: AnnotateConfig) -> Record:
    """Add `first_frame`: hands and arms replaced by what other frames show, or filled in."""
    from egosim_jax.perception.plate import clean_plate

    depth_m = record.require("depth").depth_m[0]
    margin = max(2, round(PLATE_MARGIN * record.plan.width))
    plate = clean_plate(record.frames, record.moving, record.cameras, depth_m, margin_px=margin)
    notes = {
        "hand_px": int(record.moving[0].sum()),
        "seen_px": int(plate.seen.sum()),
        "filled_by": plate.method,
    }
    return record.add("plate", notes, first_frame=plate.image)


def build_state(record: Record, parts: Estimators, config: AnnotateConfig) -> Record:
    """Add `state`, the scene that the prior shows: of the first frame, or of key frames too."""
    from egosim_jax.perception.depth import points_per_pixel

    cameras, ids, depth = record.cameras, record.object_ids, record.require("depth")
    objects = None if ids is None else np.maximum(ids[0], 0)
    state = state_from_depth(
        record.require("first_frame"),
        depth.depth_m[0],
        cameras.intrinsics_px,
        cameras.world_from_camera[0],
        object_ids=objects,
        names=record.names,
        points_per_pixel=points_per_pixel(depth.depth_m[0], cameras),
    )
    for frame, depth_m in zip(depth.frames[1:], depth.depth_m[1:], strict=True):
        state = extend_state(state, record, int(frame), depth_m)
    state = replace(state, provenance={"source": "video", "video_id": record.video_id})
    return record.add("scene", {"state": config.state, "points": len(state.points_m)}, state=state)


def extend_state(
    state: SceneState, record: Record, frame: int, depth_m: Float32[np.ndarray, "h w"]
) -> SceneState:
    """Return a state with points of a later frame where the state shows nothing in its view."""
    import cv2

    pose = record.cameras.world_from_camera[frame]
    here = replace(record.cameras, world_from_camera=pose[None])
    seen, _ = splat(state.points_m, here, point_px=POINT_PX + 1)
    hidden = cv2.dilate(record.moving[frame].astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    new = ~np.isfinite(seen[0]) & ~hidden & np.isfinite(depth_m)
    rays = pixel_rays(here.intrinsics_px, height=here.height, width=here.width)[new]
    points = transform(pose, rays * depth_m[new][:, None]).astype(np.float32)
    ids = np.maximum(record.require("object_ids")[frame], 0)[new]
    return replace(
        state,
        points_m=np.concatenate([state.points_m, points]),
        colors=np.concatenate([state.colors, record.frames[frame][new]]),
        object_ids=np.concatenate([state.object_ids, ids.astype(np.int32)]),
        last_seen=np.concatenate([state.last_seen, np.zeros(len(points), np.int32)]),
    )


def add_caption(record: Record, parts: Estimators, config: AnnotateConfig) -> Record:
    """Add `prompt`: given, known, written by a network, or by a rule that says what it knows."""
    names = sorted(set((record.names or {}).values()) | set(record.recording.names))
    if config.caption_text is not None:
        prompt, source = config.caption_text, "--caption"
    elif record.recording.caption and parts.captioner is None:
        prompt, source = record.recording.caption, "recording"
    elif parts.captioner is not None:
        prompt, source = parts.captioner(record.frames)[0], config.caption or "network"
    else:
        prompt, source = plain_caption(record, names), "rule"
    return record.add("caption", {"source": source, "names": names}, prompt=prompt)


def plain_caption(record: Record, names: list[str]) -> str:
    """Return a caption of what is known without a network: the hands in view, and names.

    It says nothing of the action, which no stage has recognized.
    """
    what = f" near {', '.join(names)}" if names else ""
    if record.recording.kind == "robot":
        return f"A robot gripper moves in view of a camera{what}."
    seen = visible(record.require("hands"))
    sides = [side for number, side in enumerate(SIDES) if seen[:, number].any()]
    if not sides:
        return f"A wearer looks at a scene without moving hands in view{what}."
    who = (
        "The wearer's two hands move" if len(sides) == 2 else f"The wearer's {sides[0]} hand moves"
    )
    return f"{who} in view of a head-mounted camera{what}."


def to_triplet(record: Record, config: AnnotateConfig) -> tuple[Triplet, dict[str, Any]]:
    """Return the triplet of a finished record, and figures of its prior."""
    prior, mask, hands, drawn = _render(record, config)
    triplet = Triplet(
        video_id=record.video_id,
        prompt=record.require("prompt"),
        prior=prior,
        mask=mask,
        hands=hands,
        first_frame=record.require("first_frame"),
        target=record.frames,
        extra={
            "split": config.split,
            "source": record.recording.video.name,
            "rung": record.require("estimate").verdict.rung,
        },
    )
    judged = drawn & ~record.moving  # the mask's observed part is wider than what is drawn
    judged[0] = False
    first = np.broadcast_to(record.frames[0], record.frames.shape)
    return triplet, {
        "seen": float((mask == 0).mean()),
        "psnr_background": _psnr(prior, record.frames, judged),
        "psnr_first_frame": _psnr(first, record.frames, judged),
    }


def _render(
    record: Record, config: AnnotateConfig
) -> tuple[
    UInt8[np.ndarray, "f h w 3"],
    UInt8[np.ndarray, "f h w"],
    UInt8[np.ndarray, "f h w 3"],
    Bool[np.ndarray, "f h w"],
]:
    """Return prior, mask, hands and the pixels where a point is drawn.

    They are rendered some frames at a time, for less memory.
    """
    from egosim_jax import rendering

    renderer, cameras = rendering.get(config.renderer), record.cameras
    state, joints_m = record.require("state"), record.require("joints_m")
    last = len(record.frames) - 1
    pieces = []
    for start in range(0, last + 1, FRAMES_AT_ONCE):
        # The last piece is filled up, so that one program is compiled for all.
        here = np.minimum(np.arange(start, start + min(FRAMES_AT_ONCE, last + 1)), last)
        some = replace(cameras, world_from_camera=cameras.world_from_camera[here])
        view = renderer.render(state, some, point_px=POINT_PX)
        hands, _ = renderer.draw_hands(joints_m[here], some, kind=record.recording.kind)
        pieces.append((view.frames, view.mask, hands, np.isfinite(view.depth_m)))
    prior, mask, hands, drawn = (
        np.concatenate(part)[: last + 1] for part in zip(*pieces, strict=True)
    )
    return prior, mask, hands, drawn


def _psnr(
    video: UInt8[np.ndarray, "f h w 3"],
    target: UInt8[np.ndarray, "f h w 3"],
    judged: Bool[np.ndarray, "f h w"],
) -> float:
    """Return the mean PSNR over the frames of some pixels; 0 without any."""
    errors = [
        np.square(frame[here].astype(np.float32) - other[here]).mean(dtype=np.float64)
        for frame, other, here in zip(video, target, judged, strict=True)
        if here.any()
    ]
    return float(decibels(np.array(errors)).mean()) if errors else 0.0


def check_prior(rung: Rung, figures: Mapping[str, float], config: AnnotateConfig) -> None:
    """Raise `RefusedError` for a prior that shows the background worse than the first frame.

    A camera that stays in its place is not judged so: its prior is the first frame, turned, and
    what its hands hid there.
    """
    if rung in ("static", "rotation"):
        return
    gain = figures["psnr_background"] - figures["psnr_first_frame"]
    least = config.cutting.quality.min_prior_gain_db
    if gain < least:
        raise RefusedError(
            "prior",
            f"prior: the background is {gain:+.1f} dB like the video, compared with the first "
            f"frame repeated; at least {least:+.1f} dB. Cameras or depth are wrong. "
            "(--min-prior-gain)",
            figures,
        )


STAGES = (
    Stage("hands", find_hands, ("hands",)),
    Stage("silhouettes", draw_silhouettes, ("object_ids", "names")),
    Stage("cameras", find_cameras, ("estimate",)),
    Stage("lens", undistort_clip),
    Stage("depth", find_depth, ("depth",)),
    Stage("scale", find_scale),
    Stage("plate", clean_first_frame, ("first_frame",)),
    Stage("scene", build_state),
    Stage("caption", add_caption, ("prompt",)),
)
"""Stages of an annotation, in order."""
FIRST_STAGES = 2
"""Stages that need no camera: the first pool of actors runs them."""
