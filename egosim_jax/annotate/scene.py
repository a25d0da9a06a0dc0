"""Last stages of an annotation: scale, moved objects, first frame without hands, state, caption."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from egosim_jax.annotate.captions import RULE, caption_by_rule
from egosim_jax.annotate.config import AnnotateConfig, Estimators
from egosim_jax.annotate.hand_tracks import visible
from egosim_jax.annotate.objects import MOVED, drop_unmeasured, find_moved_objects, join_objects
from egosim_jax.annotate.prepare import RefusedError
from egosim_jax.annotate.record import Record
from egosim_jax.annotate.stages import (
    Stage,
    draw_silhouettes,
    find_cameras,
    find_depth,
    find_hands,
    joints_in_world,
    lifted_hands,
    undistort_clip,
)
from egosim_jax.data.clip_files import prior_column
from egosim_jax.dynamics import predict
from egosim_jax.evaluation.metrics.image import decibels
from egosim_jax.geometry import invert, pixel_rays, pixels_of, transform
from egosim_jax.io.bounded import unlike
from egosim_jax.perception.video.estimates import DepthEstimate, Rung
from egosim_jax.rendering import POINT_PX
from egosim_jax.rendering.reference import splat
from egosim_jax.state.depth import state_from_depth
from egosim_jax.state.instances import find_objects
from egosim_jax.types import Action, Motion, SceneState, Triplet
from egosim_jax.types.arrays import Masks, Video

MIN_FIXED_DB = 16.0
"""Minimum PSNR of the background if the camera stays in its place, in decibels."""
PLATE_MARGIN = 1 / 80
"""Width of the border around hands that is replaced, too, as a fraction of the image width."""
FRAMES_AT_ONCE = 64
"""Number of frames that are rendered together."""


def find_scale(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Convert cameras, depth and joints to meters; note the scale, its source and uncertainty."""
    from egosim_jax.perception.video.scale import Scale, estimate_scale, scale_cameras, scale_depth

    estimate, depth = record.require("estimate"), record.require("depth")
    joints = None if record.hands is None else lifted_hands(record)
    still = depth.metric and not estimate.metric and estimate.points is None
    if still and config.scale is None:
        scale = Scale(
            meters_per_unit=1.0,
            uncertainty=0.0,
            source="metric depth",
            reason="depth is in meters, and the camera does not move",
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


def refine_scale(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Scale the scene so that fingertips have the depth of the objects that they start to move.

    This replaces a scale from hands that may have touched the scene at any time. An assumed plane
    moves behind these objects.
    """
    from egosim_jax.perception.video.scale import contact_scale, scale_cameras

    record = replace(record, depth=plane_behind_objects(record))
    contacts, joints_m = record.require("contacts"), record.joints_m
    if record.notes["scale"]["source"] != "hands" or joints_m is None or not len(contacts):
        return record
    depth = record.require("depth")
    ids, hands_m = record.require("object_ids")[0], lifted_hands(record)
    scale = contact_scale(record.cameras, depth.depth_m[0], ids, hands_m, contacts)
    if scale is None:
        return record
    factor = scale.meters_per_unit
    total = factor * record.notes["scale"]["meters_per_unit"]
    record = record.add(
        "scale", {**asdict(scale), "meters_per_unit": total},
        estimate=scale_cameras(record.require("estimate"), scale),
        depth=replace(depth, depth_m=(depth.depth_m * factor).astype(np.float32)),
    )  # fmt: skip
    return replace(record, joints_m=joints_in_world(record))


def plane_behind_objects(record: Record) -> DepthEstimate:
    """Return the depth with an assumed plane moved behind the moved objects, by their width."""
    depth, pixels = record.require("depth"), record.moved[0]
    if depth.confident.any() or not pixels.any():
        return depth
    numbers = record.require("moved_ids")
    ids = record.require("object_ids")[0]
    sides = [np.ptp(np.argwhere(ids == n), axis=0).min() + 1 for n in numbers if (ids == n).any()]
    factor = 1 + max(sides) / record.cameras.intrinsics_px[0, 0]
    depth_m = depth.depth_m * np.float32(factor)
    depth_m[0][pixels] = depth.depth_m[0][pixels]
    return replace(depth, depth_m=depth_m)


def _sparse_depth(record: Record) -> DepthEstimate:
    """Return the triangulated points as sparse depth of the first frame, in camera units."""
    estimate = record.require("estimate")
    points, cameras = estimate.points, estimate.cameras
    in_first = points.frames == 0
    local = transform(
        invert(cameras.world_from_camera[0]), points.points_m[points.indices[in_first]]
    )
    row, column, inside = pixels_of(cameras, local)
    sparse = np.full((1, cameras.height, cameras.width), np.inf, np.float32)
    sparse[0, row[inside], column[inside]] = local[inside, 2]
    return DepthEstimate(
        frames=np.zeros(1, np.int32), depth_m=sparse, confident=np.isfinite(sparse), metric=False
    )


def clean_first_frame(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Add `first_frame`: hands and arms are replaced from other frames, or inpainted."""
    from egosim_jax.perception.video.plate import clean_plate

    depth_m = record.require("depth").depth_m[0]
    margin = max(2, round(PLATE_MARGIN * record.plan.width))
    plate = clean_plate(
        record.frames, record.moving, record.cameras, depth_m, moved=record.moved, margin_px=margin
    )
    notes = {
        "hand_px": int(record.moving[0].sum()),
        "seen_px": int(plate.seen.sum()),
        "filled_by": plate.method,
        "hidden": round(float(record.moving[0].mean()), 4),
    }
    return record.add("plate", notes, first_frame=plate.image)


def build_state(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Add `state`, the scene of the prior, from the first frame or also from key frames."""
    from egosim_jax.perception.video.depth import points_per_pixel

    cameras, depth = record.cameras, record.require("depth")
    ids, names = np.maximum(record.require("object_ids")[0], 0), dict(record.names or {})
    if estimators.segmenter is None and depth.confident[0].any():  # not on an assumed plane
        standing = find_objects(
            record.require("first_frame"), depth.depth_m[0], cameras.intrinsics_px
        )
        ids, names = join_objects(ids, names, drop_unmeasured(standing, depth.confident[0]))
    state = state_from_depth(
        record.require("first_frame"),
        depth.depth_m[0],
        cameras.intrinsics_px,
        cameras.world_from_camera[0],
        object_ids=ids,
        names=names,
        points_per_pixel=points_per_pixel(depth.depth_m[0], cameras),
    )
    for frame, depth_m in zip(depth.frames[1:], depth.depth_m[1:], strict=True):
        state = extend_state(state, record, int(frame), depth_m)
    state = replace(state, provenance={"source": "video", "video_id": record.video_id})
    notes = {"state": config.state, "points": len(state.points_m), "objects": names}
    return record.add("scene", notes, state=state)


def extend_state(
    state: SceneState, record: Record, frame: int, depth_m: Float32[np.ndarray, "h w"]
) -> SceneState:
    """Return a state with the points of a later frame that the state does not cover."""
    import cv2

    pose = record.cameras.world_from_camera[frame]
    here = replace(record.cameras, world_from_camera=pose[None])
    # Slightly larger points than in the prior close the gaps between the points of a surface.
    seen, _ = splat(state.points_m, here, point_px=POINT_PX + 1)
    hidden = (record.moving[frame] | record.moved[frame]).astype(np.uint8)
    hidden = cv2.dilate(hidden, np.ones((7, 7), np.uint8)) > 0
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


def add_caption(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Add `prompt`: given, recorded, written by a network, or made by a rule."""
    named = {name for name in (record.names or {}).values() if not name.startswith(MOVED)}
    names = sorted(named | set(record.recording.names))
    if config.caption_text is not None:
        prompt, source = config.caption_text, "--caption"
    elif record.recording.caption and estimators.captioner is None:
        prompt, source = record.recording.caption, "recording"
    elif estimators.captioner is not None:
        prompt, source = estimators.captioner(record.frames)[0], config.caption or "network"
    else:
        human = record.recording.kind == "human"
        seen = np.asarray(visible(record.require("hands")).any(axis=0)).tolist() if human else []
        prompt, source = caption_by_rule(seen, names, record.recording.kind), RULE
    return record.add("caption", {"source": source, "names": names}, prompt=prompt)


def to_triplet(record: Record, config: AnnotateConfig) -> tuple[Triplet, dict[str, Any]]:
    """Return the triplet of a finished record, and quality figures of its prior."""
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
            **prior_column(config.prior),
        },
    )
    # Not the mask: its observed region is wider than the points.
    judged = drawn & ~record.moving & ~record.moved
    drawn_first = _psnr(prior[:1], record.frames[:1], judged[:1])
    judged[0] = False
    first = np.broadcast_to(record.frames[0], record.frames.shape)
    return triplet, {
        "seen": float((mask == 0).mean()),
        "psnr_background": _psnr(prior, record.frames, judged),
        "psnr_first_frame": _psnr(first, record.frames, judged),
        "psnr_drawn": drawn_first,
    }


def _render(
    record: Record, config: AnnotateConfig
) -> tuple[
    Video,
    UInt8[np.ndarray, "f h w"],
    Video,
    Masks,
]:
    """Return prior, mask, hands, and the pixels with a point, rendered in chunks to save memory."""
    from egosim_jax import rendering

    renderer, cameras = rendering.get(config.renderer), record.cameras
    state, joints_m = record.require("state"), record.require("joints_m")
    last = len(record.frames) - 1
    motion = _motion(record) if config.prior == "predicted" else None
    pieces = []
    for start in range(0, last + 1, FRAMES_AT_ONCE):
        # Padding the last chunk keeps one shape, and so one compiled program.
        here = np.minimum(np.arange(start, start + min(FRAMES_AT_ONCE, last + 1)), last)
        some = replace(cameras, world_from_camera=cameras.world_from_camera[here])
        moving = None if motion is None else motion.at(here)
        view = renderer.render(state, some, point_px=POINT_PX, motion=moving)
        hands, _ = renderer.draw_hands(joints_m[here], some, kind=record.recording.kind)
        pieces.append((view.frames, view.mask, hands, np.isfinite(view.depth_m)))
    prior, mask, hands, drawn = (
        np.concatenate(piece)[: last + 1] for piece in zip(*pieces, strict=True)
    )
    return prior, mask, hands, drawn


def _motion(record: Record) -> Motion:
    """Predict how the recorded hands move the objects of the state."""
    action = Action(
        cameras=record.cameras,
        joints_m=record.require("joints_m"),
        kind=record.recording.kind,
        prompt=record.require("prompt"),
    )
    return predict(record.require("state"), action, fps=round(record.fps) or 1)


def _psnr(video: Video, target: Video, judged: Masks) -> float:
    """Return the PSNR over the judged pixels, mean over frames; 0 without such pixels."""
    errors = [
        np.square(frame[here].astype(np.float32) - other[here]).mean(dtype=np.float64)
        for frame, other, here in zip(video, target, judged, strict=True)
        if here.any()
    ]
    return float(decibels(np.array(errors)).mean()) if errors else 0.0


def check_prior(rung: Rung, figures: Mapping[str, float], config: AnnotateConfig) -> None:
    """Raise `RefusedError` if the prior shows the background worse than the first frame does.

    A camera that stays or turns in its place must also show the first frame's background again.
    """
    fixed = rung in ("static", "rotation")  # the prior is the first frame itself, at most turned
    shown, first = figures["psnr_background"], figures["psnr_first_frame"]
    if fixed:  # the points do not draw the first frame exactly
        first = -10 * np.log10(10 ** (-first / 10) + 10 ** (-figures["psnr_drawn"] / 10))
    gain = shown - first
    limit = config.cutting.quality.min_prior_gain_db
    if gain < limit:
        raise RefusedError(
            "prior",
            f"prior: the PSNR of the background is {gain:+.1f} dB relative to the repeated first "
            f"frame, below {limit:+.1f} dB. Cameras or depth are wrong. (--min-prior-gain)",
            figures,
        )
    if fixed and shown < MIN_FIXED_DB and np.isfinite(limit):
        raise RefusedError(
            "prior",
            f"prior: the PSNR of the background is {unlike(shown, MIN_FIXED_DB, '.1f')} dB, below "
            f"{MIN_FIXED_DB:g} dB: the camera seems fixed ({rung}), but the scene changes, as in a "
            f"recording of a screen. {config.cutting.advice('whose scene stays')}Choose another "
            "camera method (--rung), or allow it by --min-prior-gain=-inf. (--min-prior-gain)",
            figures,
        )


STAGES = (
    Stage("hands", find_hands, ("hands",)),
    Stage("silhouettes", draw_silhouettes, ("object_ids", "names")),
    Stage("cameras", find_cameras, ("estimate",)),
    Stage("lens", undistort_clip),
    Stage("depth", find_depth, ("depth",)),
    Stage("scale", find_scale),
    Stage("objects", find_moved_objects, ("object_ids", "names", "moved_ids", "contacts")),
    Stage("contact", refine_scale),
    Stage("plate", clean_first_frame, ("first_frame",)),
    Stage("scene", build_state),
    Stage("caption", add_caption, ("prompt",)),
)
"""Stages of an annotation, in order."""
FIRST_STAGES = 2
"""Number of stages that need no cameras; the first pool of Ray actors runs them."""
