"""Motion of held objects by analysis by synthesis.

A grasped object moves with the hand. A candidate combines an object near a fingertip, two frames
of a possible hold, and a motion of the hand that the object may follow (`grasps`). Its cost is the
mean difference between the object's colors and the clip's colors where the object would be visible.
The candidate that most improves on the object at rest is accepted. If the time of the release is
unknown, the whole scene that each end predicts decides between the best ends. An object between
the closing fingertips counts as moved unless the clip clearly shows it at rest. If they hold
nothing with an id, candidates are grown from the points between them (`growth`), and `extent`
chooses how far. A released object falls or is put down (`falling`), and `pose_refinement` refines
its last pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from egosim_jax.geometry import invert, pixels_of, transform
from egosim_jax.perception.extent import (
    Candidate,
    best_of,
    choose_extent,
    moving_part,
    with_other_ends,
)
from egosim_jax.perception.falling import fall, snap
from egosim_jax.perception.grasps import (
    MIN_HELD,
    TIPS,
    Grip,
    closes_to_end,
    complete_hand,
    couplings,
    encloses,
    is_along_edge,
    is_firm,
    seen_frames,
)
from egosim_jax.perception.growth import NEW, Growth, clusters_without_id
from egosim_jax.perception.hulls import hull_on_plane
from egosim_jax.perception.object_models import ObjectModels, Support
from egosim_jax.perception.pipeline import Observation
from egosim_jax.perception.pose_refinement import (
    ColorCost,
    ObjectModel,
    ObjectMotion,
    Refinement,
    refine_pose,
)
from egosim_jax.state.new_objects import next_object_id
from egosim_jax.types import Action, Cameras, Clip, InputError, SceneState, check_counts
from egosim_jax.types.data import object_name


@dataclass(frozen=True, kw_only=True)
class TrackObjects:
    """Stage that sets motions, supporting planes and interaction frames of held objects."""

    reach_m: float = 0.06
    """Maximum distance from a fingertip to a candidate object, in meters."""
    opening_tolerance_m: float = 0.01
    """Maximum change of the distance between fingertips during a hold, in meters."""
    ends: int = 8
    """Maximum number of ends that are compared if the time of the release is unknown."""
    compared_points: int = 150
    """Approximate number of an object's points that a trial compares."""
    min_visible: float = 0.2
    """Minimum visible fraction of the compared points."""
    max_cost_ratio: float = 0.9
    """Maximum cost of an accepted motion, as a fraction of the cost at rest."""
    min_improvement: float = 2.0
    """Minimum reduction of the cost at rest by an accepted motion, in 8-bit levels."""
    grip_radius_m: float = 0.012
    """Maximum distance of a gripped object from the line between the fingertips, in meters."""
    grip_evidence: float = 8.0
    """Maximum cost of a gripped object's motion above the cost at rest, in 8-bit levels."""
    firm_evidence: float = 90.0
    """The same for an object that a hand holds firmly and carries away.

    A generated clip may leave an object where the state has it, as if no hand had taken it."""
    prompt_prior: float = 0.9
    """Cost factor of an object that the prompt names."""
    support: Support = field(default_factory=Support)
    """Fit of the supporting planes."""
    blur_px: float = 0.7
    """Sigma of the Gaussian blur of the clip: generated frames are softer than points."""
    growth: Growth = field(default_factory=Growth)
    """Segmentation of an object without an id."""
    part: float = 0.9
    """Maximum size of a moving part, as a fraction of the whole connected cluster."""
    color: ColorCost = field(default_factory=ColorCost)
    """Comparison of the clip's colors with the predicted colors."""
    refinement: Refinement = field(
        default_factory=partial(Refinement, deviation_m=0.003, deviation_deg=5.0)
    )
    """Refinement of the object's last pose."""

    def __post_init__(self) -> None:
        """Check that the numbers of points, the tolerance and the blur are positive."""
        check_counts({n: getattr(self, n) for n in ("ends", "compared_points")})
        for name in ("opening_tolerance_m", "blur_px"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name} must be positive, not {getattr(self, name)}.")

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `motions`, `support_planes`, `held` and `interacted_frames`.

        Pixels of hands are ignored.
        """
        cameras, joints, ids = (
            so_far.require(name, "TrackObjects") for name in ("cameras", "joints_m", "object_ids")
        )
        action = replace(action, cameras=cameras, joints_m=joints)
        models = ObjectModels(state, cameras.world_from_camera[0], self.support)
        found, new, notes = estimate_object_motion(clip, action, models, ids < 0, self)
        frames, moved = np.arange(len(clip.frames)), list(found.values())
        held = {hand: motion.model.number for hand, motion in found.items() if motion.holds_to_end}
        for hand, number in state.held.items():
            in_view = hand < joints.shape[1] and len(seen_frames(joints[:, hand]))
            if not in_view:
                held[hand] = number
        held = {**_closed_on(action, models, found, self), **held}
        return replace(
            so_far,
            new_objects=new,
            names={**(so_far.names or {}), **{number: object_name(number, {}) for number in new}},
            notes=(*so_far.notes, *notes),
            held=held,
            motions={m.model.number: m.path for m in moved},
            support_planes={m.model.number: m.model.plane for m in moved},
            interacted_frames={
                m.model.number: (frames >= m.grasped) & (frames <= m.released) for m in moved
            },
        )


def estimate_object_motion(
    clip: Clip,
    action: Action,
    models: ObjectModels,
    hidden: Bool[np.ndarray, "f h w"],
    config: TrackObjects,
) -> tuple[dict[int, ObjectMotion], dict[int, Float32[np.ndarray, "n 3"]], list[str]]:
    """Return the motion of the object that each hand moved, the new objects' points, and notes.

    Each hand moves at most one object. If two hands claim an object, the hand that explains the
    colors better gets it. `hidden` marks the pixels that hands cover. A hand may
    be missing from some frames (`Grip`). Without an object with an id in its grip, a hand may move
    a new one: it gets the next free id, and `models` has it then.
    """
    shown = _smooth(clip.frames, config.blur_px)
    found: dict[int, tuple[float, int, ObjectMotion]] = {}
    new: dict[int, Float32[np.ndarray, "n 3"]] = {}
    notes: list[str] = []
    for hand in range(action.joints_m.shape[1]):
        joints = action.joints_m[:, hand]
        if len(seen_frames(joints)) > MIN_HELD:
            best, note = _best_candidate(hand, action, models, shown, hidden, config)
            if best is not None and best[1].model.number == NEW:
                change, motion = best
                number = next_object_id(models.state)
                motion = replace(motion, model=replace(motion.model, number=number))
                best = change, motion
                new[number] = motion.model.points_m.astype(np.float32)
                models.add(new)
                note = f"moved something without an id: it is object {number} now"
            if note:
                notes.append(f"{_hand_name(action, hand)} {note}")
            if best is not None:
                change, motion = best
                state = models.state
                others = state.points_m[state.object_ids != motion.model.number]
                motion = snap(fall(motion, others, clip.fps), others)
                motion = refine_pose(
                    motion, action.cameras, state, shown, hidden, config.refinement, config.color
                )
                motion = snap(motion, others)
                number = motion.model.number
                if number not in found or change < found[number][0]:
                    found[number] = change, hand, motion
    return {hand: motion for _, hand, motion in found.values()}, new, notes


def _closed_on(
    action: Action, models: ObjectModels, found: Mapping[int, ObjectMotion], config: TrackObjects
) -> dict[int, int]:
    """Return the object that each hand closes on until the clip ends: it has not held it yet."""
    motions = {motion.model.number: motion.path[-1] for motion in found.values()}
    held = {}
    for hand in range(action.joints_m.shape[1]):
        joints = action.joints_m[:, hand]
        seen = seen_frames(joints)
        if not len(seen) or seen[-1] != len(joints) - 1:
            continue
        tips = complete_hand(joints, seen)[:, TIPS[action.kind]]
        if not closes_to_end(tips, config.opening_tolerance_m):
            continue
        for number in _near_tips(tips, models, config):
            model = models.of(number)
            end = transform(motions.get(number, np.eye(4)), model.points_m)
            faces = hull_on_plane(end, model.plane)
            if faces is not None and encloses(faces, tips[-1]):
                held[hand] = number
    return held


def _hand_name(action: Action, hand: int) -> str:
    """Return how a note calls a hand of an action: by its number, if others are shown."""
    one = "gripper" if action.kind == "robot" else "hand"
    shown = np.isfinite(action.joints_m).all(axis=(2, 3)).any(axis=0).sum()
    return f"{one} {hand}" if shown > 1 else f"the {one}"


def _best_candidate(
    hand: int,
    action: Action,
    models: ObjectModels,
    shown: Float32[np.ndarray, "f h w 3"],
    hidden: Bool[np.ndarray, "f h w"],
    config: TrackObjects,
) -> tuple[Candidate | None, str]:
    """Return the best accepted candidate of one hand, and a note.

    If the hand holds no object that has an id, it may move one that has none.
    """
    state = models.state
    before = state.held.get(hand, 0)
    grip = Grip.of(
        action.joints_m[:, hand],
        action.kind,
        action.cameras.world_from_camera[:, :3, 3],
        tolerance_m=config.opening_tolerance_m,
        radius_m=config.grip_radius_m,
        before=(before, state.points_m[state.object_ids == before]) if before else None,
    )
    scene = action.cameras, state, shown, hidden, config.color
    found: list[list[Candidate]] = []
    held = False
    for number in _near_tips(grip.tips_m, models, config):
        model = models.of(number)
        held |= any(grip.has(model.points_m, grasped) for grasped in grip.grasps)
        name = state.names.get(number, "").lower()
        prior = config.prompt_prior if name and name in action.prompt.lower() else 1.0
        found.append(_best_motions(model, grip, prior, action.cameras, shown, hidden, config))
    if held:
        best = best_of(found, *scene)
        return best, _doubt(best, grip, state)
    clusters, note = clusters_without_id(grip, action.cameras, state, config.growth)
    for growths in clusters:
        tried = [
            _best_motions(model, grip, 1.0, action.cameras, shown, hidden, config)
            for model in growths
        ]
        moved = [ranked for ranked in tried if ranked]
        if moved:
            part = moving_part(moved[0][0][1], action.cameras, shown, hidden, config.color)
            if (
                config.support.min_points
                <= len(part.points_m)
                < config.part * len(growths[0].points_m)
            ):
                ranked = _best_motions(part, grip, 1.0, action.cameras, shown, hidden, config)
                moved += [ranked] if ranked else []
            found.append(moved[choose_extent([r[0] for r in moved], growths, *scene)])
    if best := best_of(found, *scene):
        return best, _doubt(best, grip, state)
    if clusters and grip.sure:
        note = "closed on something without an id that the clip shows at rest"
    return None, note


def _doubt(best: Candidate | None, grip: Grip, state: SceneState) -> str:
    """Return a note on what speaks against a motion; empty if nothing does."""
    if best is None:
        return ""
    name = object_name(best[1].model.number, state.names)
    if best[1].by_grip:
        return f"carried {name}, as its grip shows, but the clip shows it at rest"
    return "" if grip.sure else f"may have held {name}: its fingers do not show when"


def _best_motions(
    model: ObjectModel,
    grip: Grip,
    prior: float,
    cameras: Cameras,
    shown: Float32[np.ndarray, "f h w 3"],
    hidden: Bool[np.ndarray, "f h w"],
    config: TrackObjects,
) -> list[Candidate]:
    """Return the accepted motions of an object with one hand, after their change of cost.

    The change is relative to the object at rest, because an object in the table's color costs
    little anywhere. It is 0 if the object is not visible, and lower for an object in the grip.
    The first motion has the lowest. If the opening does not say when the hand held the object, the
    best ones with other ends follow. A hold begins with a fingertip within reach of the object.
    """
    accepted: list[Candidate] = []
    still = np.repeat(np.eye(4)[None], len(shown), axis=0)
    rest = _cost(model, still, cameras, shown, hidden, config)
    improvement = max(config.min_improvement, (1 - config.max_cost_ratio) * rest)
    faces = hull_on_plane(model.points_m, model.plane)
    some = model.points_m[:: max(1, len(model.points_m) // config.compared_points)]
    gaps_m = np.linalg.norm(grip.tips_m[:, :, None] - some, axis=-1).min(axis=(1, 2))
    for hold in grip.holds:
        if gaps_m[hold[0]] > config.reach_m:
            continue  # a hand that is far away takes nothing
        gripped = grip.has(model.points_m, hold[0])
        max_change = config.grip_evidence if gripped else -improvement
        carried = hold[0] == 0 and grip.carried == model.number
        if gripped and (carried or (faces is not None and is_firm(faces, grip.tips_m, hold))):
            max_change = config.firm_evidence
        loose = couplings(grip.palm_m, grip.rigid[hold[0]], model.plane[:3], hold)
        hinge = grip.hinges[hold]
        if hinge is not None and is_along_edge(model.points_m, hinge):
            loose = ()  # fingertips on an arc about an object's edge: a hand that carries has none
        for path in (*loose, hinge):
            if path is None:
                continue
            cost = prior * _cost(model, path, cameras, shown, hidden, config)
            known = bool(np.isfinite(cost) and np.isfinite(rest))
            change = (cost - rest if known else 0.0) - max_change
            if change < 0:
                motion = ObjectMotion(
                    model=model,
                    grasped=hold[0],
                    released=hold[1],
                    path=path,
                    hinged=path is hinge,
                    by_grip=known and cost > rest + config.min_improvement,
                )
                accepted.append((change, motion))
    accepted.sort(key=lambda candidate: candidate[0])
    return accepted[:1] if grip.sure else with_other_ends(accepted, config.ends)


def _near_tips(
    tips_m: Float[np.ndarray, "f t 3"], models: ObjectModels, config: TrackObjects
) -> list[int]:
    return models.near(tips_m, reach_m=config.reach_m, compared=config.compared_points)


def _cost(
    model: ObjectModel,
    path: Float[np.ndarray, "f 4 4"],
    cameras: Cameras,
    shown: Float32[np.ndarray, "f h w 3"],
    hidden: Bool[np.ndarray, "f h w"],
    config: TrackObjects,
) -> float:
    """Return the mean difference between the object's colors and the clip's where it projects.

    Points behind a hand are ignored. The cost is infinite if too few points are visible.
    """
    every = max(1, len(model.points_m) // config.compared_points)
    points, colors = model.points_m[::every], model.colors[::every]
    local = transform(invert(cameras.world_from_camera) @ path, points)
    row, column, inside = pixels_of(cameras, local)
    frame = np.broadcast_to(np.arange(len(path))[:, None], column.shape)
    pixel = frame[inside], row[inside], column[inside]
    visible = ~hidden[pixel]
    if visible.sum() < config.min_visible * column.size:
        return float("inf")
    expected = np.broadcast_to(colors, (*column.shape, 3))[inside][visible]
    return config.color.mean(shown[pixel][visible], expected)


def _smooth(frames: UInt8[np.ndarray, "f h w 3"], sigma: float) -> Float32[np.ndarray, "f h w 3"]:
    import cv2

    return np.stack([cv2.GaussianBlur(f.astype(np.float32), (0, 0), sigma) for f in frames])
