"""Tracks of hands in an annotation: which detections are hands, and where lost ones are."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
from jaxtyping import Bool

from egosim_jax.annotate.config import Side
from egosim_jax.annotate.prepare import RefusedError
from egosim_jax.dynamics.hands import PALM
from egosim_jax.io.bounded import unlike
from egosim_jax.perception.video.estimates import LEFT, RIGHT, HandTracks
from egosim_jax.types.arrays import Video

MAX_BOTH = 0.1
"""Maximum fraction of frames with two hands in a clip whose one hand has a given side."""
FLASH_S = 0.3
"""Minimum time in seconds for which a second hand must be visible."""
OVER_S, OVER_SIZE = 1.0, 0.5
"""The same for a second hand on the first one, and the maximum distance of their palms.

The distance is the median over frames, as a share of the larger hand."""
HOLD_S = 0.5
"""Time in seconds for which the silhouette of a lost hand is kept."""
GAP_S = 1.5
"""Longest gap in seconds in which the silhouette moves from one detection to the next."""
OTHER_LEVELS, OTHER_SHARE = 25, 0.8
"""Minimum difference in 8-bit levels, in a minimum share of a hand's pixels, of another content.

A hand that moved for 0.1 s changes at most 0.74 of them, a hand that is not there yet 0.98 (30
frames per second, lift_tumbler)."""


def visible(hands: HandTracks) -> Bool[np.ndarray, "f 2"]:
    """Return True for each frame and hand that was found."""
    return np.asarray(np.isfinite(hands.joints_px).all(axis=(2, 3)))


def share_of_both(seen: np.ndarray) -> float:
    """Return the fraction of frames in which both hands are visible."""
    return float(np.all(seen, axis=1).mean())


def without(hands: HandTracks, dropped: Bool[np.ndarray, "f 2"]) -> HandTracks:
    """Return tracks in which some hands are missing."""
    joints = dropped[..., None, None]
    return HandTracks(
        joints_px=np.where(joints, np.nan, hands.joints_px),
        joints_hand_m=np.where(joints, np.nan, hands.joints_hand_m),
        presence=np.where(dropped, 0, hands.presence),
        filled=None if hands.filled is None else hands.filled & ~dropped,
        mirrored=None if hands.mirrored is None else hands.mirrored & ~dropped,
    )


def drop_flashes(hands: HandTracks, fps: Fraction) -> HandTracks:
    """Return tracks without second hands that appear only for a moment.

    If a hand is found for less than 0.3 s, not within 0.5 s before or after, and always together
    with the other hand, it is a second detection of the other hand. So is one that is found for
    less than 1 s on the other hand.
    """
    seen = visible(hands)
    palms = hands.joints_px[:, :, PALM["human"]].mean(axis=2)
    sizes = np.ptp(hands.joints_px, axis=2).max(axis=(1, 2))
    apart = np.linalg.norm(palms[:, LEFT] - palms[:, RIGHT], axis=-1) / sizes
    dropped = np.zeros_like(seen)
    for side in (LEFT, RIGHT):
        frames = np.flatnonzero(seen[:, side])
        for run in np.split(frames, np.flatnonzero(np.diff(frames) > HOLD_S * fps) + 1):
            if not len(run) or not seen[run, 1 - side].all():
                continue
            limit = OVER_S if np.median(apart[run]) <= OVER_SIZE else FLASH_S
            if len(run) < limit * fps:
                dropped[run, side] = True
    return without(hands, dropped)


def hold_hands(hands: HandTracks, fps: Fraction) -> HandTracks:
    """Return tracks in which a hand moves straight through a gap of at most 1.5 s.

    In other frames, a lost hand keeps its nearest detection in time for 0.5 s. For silhouettes
    only: a hand that enters, leaves or is lost for a moment must not become part of the scene.
    """
    from egosim_jax.perception.video.hands.track import fill_gaps, runs

    joints_px, joints_hand_m = hands.joints_px.copy(), hands.joints_hand_m.copy()
    seen, frames = visible(hands), np.arange(len(hands.presence))
    gaps = np.zeros_like(seen)
    for side in (LEFT, RIGHT):
        frames_seen = np.flatnonzero(seen[:, side])
        if len(frames_seen):
            nearest = frames_seen[np.abs(frames[:, None] - frames_seen).argmin(axis=1)]
            near = np.abs(nearest - frames) <= HOLD_S * fps
            joints_px[near, side] = hands.joints_px[nearest[near], side]
            joints_hand_m[near, side] = hands.joints_hand_m[nearest[near], side]
        for start, stop in runs(~seen[:, side]):
            within = start > 0 and stop < len(seen)
            gaps[start:stop, side] = within and stop + 1 - start <= GAP_S * fps
    joints_px, joints_hand_m = (fill_gaps(joints, gaps) for joints in (joints_px, joints_hand_m))
    return replace(hands, joints_px=joints_px, joints_hand_m=joints_hand_m)


def before_entry(hands: HandTracks, frames: Video) -> Bool[np.ndarray, "f 2"]:
    """Return True for hands that are not in the first frame, but enter soon after.

    The first frame shows something else where the hand is found first. Its silhouette must not be
    kept there (`hold_hands`): nothing is hidden, and pixels of the hand would be taken for it.
    """
    import cv2

    seen, absent = visible(hands), np.zeros((len(frames), 2), bool)
    for side in (LEFT, RIGHT):
        frames_seen = np.flatnonzero(seen[:, side])
        if not len(frames_seen) or frames_seen[0] == 0:
            continue
        at, inside = int(frames_seen[0]), np.zeros(frames.shape[1:3], np.uint8)
        outline = cv2.convexHull(hands.joints_px[at, side].astype(np.int32))
        cv2.fillConvexPoly(inside, outline, 1)
        change = cv2.absdiff(frames[0], frames[at]).max(axis=-1)[inside > 0]
        absent[0, side] = len(change) > 0 and (change > OTHER_LEVELS).mean() >= OTHER_SHARE
    return absent


def on_side(hands: HandTracks, side: Side) -> HandTracks:
    """Return tracks with only the most confident hand of each frame, on the given side.

    Raises `RefusedError` if two hands are visible: their tracks would become one.
    """
    if side == "auto":
        return hands
    if (share := share_of_both(visible(hands))) > MAX_BOTH:
        raise RefusedError(
            "hands",
            f"hands: two are visible in {unlike(100 * share, 100 * MAX_BOTH, '.0f')}% of the "
            f"frames, more than {MAX_BOTH:.0%}: a side can be given to a clip with one hand. Omit "
            "it. (--side)",
            {"both": share},
        )
    index = LEFT if side == "left" else RIGHT
    best = np.argmax(np.where(visible(hands), hands.presence, -1), axis=1)
    frames = np.arange(len(best))
    moved: dict[str, Any] = {"filled": None, "mirrored": None}
    for name, missing in (
        ("joints_px", np.nan), ("joints_hand_m", np.nan), ("presence", 0), ("filled", False),
        ("mirrored", False),
    ):  # fmt: skip
        if (values := getattr(hands, name)) is not None:
            moved[name] = np.full_like(values, missing)
            moved[name][:, index] = values[frames, best]
    return HandTracks(**moved)
