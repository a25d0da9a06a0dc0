"""Candidate hands in every frame, by palm detection and by following hands between frames.

1. Detect palms in all tiles of all frames.
2. Find keypoints in the palms' regions.
3. Search for each new hand in the previous and the next frame, in the region that its keypoints
   predict. Repeat until there are no new hands. This finds hands in frames without a visible palm.
4. Find the keypoints of each hand again in its own region, which is narrower than a palm's.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from egosim_jax.perception.video.hands.litert import HandNetworks
from egosim_jax.perception.video.hands.palms import Palms, cut_tile, decode_palms, make_tiles
from egosim_jax.perception.video.hands.regions import (
    Regions,
    crop_region,
    joints_in_image,
    regions_of_joints,
    regions_of_palms,
    unrotate,
)
from egosim_jax.types.arrays import Video

_PALM = [0, 1, 2, 5, 9, 13, 17]
_KNUCKLES = [5, 9, 13, 17]
_BENT = [7, 8, 11, 12, 15, 16, 19, 20]
_FOREARM_NATS = 10
"""Log odds of a right hand per image width from the middle to where the forearm enters."""
_BEND_NATS = 10
"""Log odds of a right hand per palm length of the fingers' bend along the palm's normal."""
_OTHER_REGIONS = [(turn, scale) for turn in (-0.5, -0.25, 0.25, 0.5) for scale in (1.0, 1.4)]
"""Turns in radians and scales of the regions to search for a hand of the other side."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Candidates:
    """Possible hands, of all frames."""

    frame: Int[np.ndarray, " n"]
    """Frame of each candidate."""
    joints_px: Float[np.ndarray, "n 21 2"]
    """Columns and rows of the keypoints in pixels."""
    joints_hand_m: Float[np.ndarray, "n 21 3"]
    """Keypoints of a hand of mean size in meters, in camera axes, up to a translation."""
    presence: Float[np.ndarray, " n"]
    """Confidence from 0 to 1 in the presence of a hand."""
    right: Float[np.ndarray, " n"]
    """Probability of a right hand, from the network."""
    bend_right: Float[np.ndarray, " n"]
    """Probability of a right hand, from the bend of the fingers."""
    forearm_right: Float[np.ndarray, " n"]
    """Probability of a right hand, from where the forearm enters the image."""
    palm: Float[np.ndarray, " n"]
    """Confidence from 0 to 1 of a detected palm at the joints."""
    again: Bool[np.ndarray, " n"]
    """True for alternative joints of a hand already found (`find_other_side`)."""

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self.frame)

    def take(self, index: np.ndarray) -> Candidates:
        """Return the candidates selected by indices or a mask."""
        return Candidates(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def join(self, other: Candidates) -> Candidates:
        """Return these candidates followed by others."""
        return Candidates(
            **{
                f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)])
                for f in fields(self)
            }
        )

    @property
    def seems_right(self) -> Bool[np.ndarray, " n"]:
        """True for hands whose joints look like a right hand's."""
        return (self.right + self.bend_right) / 2 > 0.5

    @property
    def size_px(self) -> Float[np.ndarray, " n"]:
        """Size of each hand in pixels (`spread`)."""
        return spread(self.joints_px)


def spread(joints_px: Float[np.ndarray, "*n 21 2"]) -> Float[np.ndarray, "*n"]:
    """Return twice the root mean square distance of a hand's joints from their mean."""
    offsets = joints_px - joints_px.mean(-2, keepdims=True)
    return 2 * np.sqrt((offsets**2).sum(-1).mean(-1))


def relative_distance(
    one: Float[np.ndarray, "*#n 21 2"], other: Float[np.ndarray, "*#n 21 2"]
) -> Float[np.ndarray, ...]:
    """Return the mean distance between two hands' joints, in sizes of the larger hand."""
    distance = np.linalg.norm(one - other, axis=-1).mean(-1)
    return distance / np.maximum(np.maximum(spread(one), spread(other)), 1e-6)


def right_by_forearm(
    joints_px: Float[np.ndarray, "n 21 2"], height: int, width: int
) -> Float[np.ndarray, " n"]:
    """Return the probability of right hands from where their forearms enter the image.

    A forearm continues the line from the knuckles to the wrist. A right forearm crosses the image
    border to the right of the middle. A forearm that crosses the upper border is no evidence.
    """
    wrist, size = joints_px[:, 0], np.array([width, height])
    along = wrist - joints_px[:, _KNUCKLES].mean(1)
    ahead = np.where(along > 0, size - wrist, -wrist)
    steps = ahead / np.where(along == 0, 1e-9, along)
    column, row = ((wrist + steps.clip(0).min(1, keepdims=True) * along) / size).T
    odds = np.clip(_FOREARM_NATS * (column - 0.5), -4, 4)
    return np.where(row < 0.05, 0.5, 1 / (1 + np.exp(-odds)))


def right_by_bend(joints_m: Float[np.ndarray, "n 21 3"]) -> Float[np.ndarray, " n"]:
    """Return the probability of right hands from the side of the palm to which fingers bend."""
    palm = joints_m[:, _KNUCKLES] - joints_m[:, :1]
    normal = np.cross(palm[:, 0], palm[:, -1])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    bend = joints_m[:, _BENT].mean(1) - joints_m[:, _KNUCKLES].mean(1)
    length = np.maximum(np.linalg.norm(palm[:, 1], axis=-1), 1e-9)
    return 1 / (1 + np.exp(-np.clip(_BEND_NATS * (bend * normal).sum(-1) / length, -4, 4)))


def find_other_side(
    frames: Video,
    networks: HandNetworks,
    hands: Candidates,
    *,
    right: bool,
    min_presence: float,
    same_hand: float,
) -> Candidates:
    """Return hands of one side at the places of candidates that look like the other side.

    With hidden fingers, the network's side depends on the exact region. In a turned and enlarged
    region it often finds the correct side, and so joints that are not mirrored.
    """
    seen = hands.take(np.zeros(0, int))
    places = regions_of_joints(hands.joints_px)
    for turn, scale in _OTHER_REGIONS:
        regions = replace(places, angle=places.angle + turn, size_px=places.size_px * scale)
        refined = find_joints(frames, networks, hands.frame, regions, 0.0)
        refined = replace(
            refined,
            palm=hands.palm,
            again=np.ones(len(hands), bool),
            forearm_right=right_by_forearm(refined.joints_px, *frames.shape[1:3]),
        )
        wanted = (refined.presence >= min_presence) & (refined.seems_right == right)
        seen = seen.join(refined.take(wanted))
    return _once(seen, same_hand)


def find_candidates(
    frames: Video,
    networks: HandNetworks,
    *,
    min_palm: float,
    min_presence: float,
    same_hand: float,
    wanted: np.ndarray | None = None,
) -> Candidates:
    """Return the candidates of all frames, without duplicates.

    `same_hand` is the relative distance below which two candidates of a frame are one hand. Only
    the `wanted` frames are searched, all if None.
    """
    searched = np.arange(len(frames)) if wanted is None else np.flatnonzero(wanted)
    palms = _find_palms(frames, networks, searched, min_palm)
    numbers = np.repeat(searched, [len(p.score) for p in palms])
    regions = regions_of_palms(
        np.concatenate([np.zeros((0, 4)), *(p.boxes_px for p in palms)]),
        np.concatenate([np.zeros((0, 7, 2)), *(p.keypoints_px for p in palms)]),
    )
    candidates = find_joints(frames, networks, numbers, regions, min_presence)
    candidates = _once(candidates, same_hand)
    fresh = candidates
    allowed = np.ones(len(frames), bool) if wanted is None else wanted
    for _ in range(len(frames)):
        ahead = _followed(fresh, candidates, allowed, same_hand)
        if not len(ahead):
            break
        fresh = find_joints(
            frames, networks, ahead.frame, regions_of_joints(ahead.joints_px), min_presence
        )
        fresh = _new_ones(_once(fresh, same_hand), candidates, same_hand)
        candidates = candidates.join(fresh)
    candidates = _refined(frames, networks, candidates, min_presence, same_hand)
    candidates = replace(
        candidates, forearm_right=right_by_forearm(candidates.joints_px, *frames.shape[1:3])
    )
    of_frame = dict(zip(searched.tolist(), palms, strict=True))
    for i, frame in enumerate(candidates.frame):
        candidates.palm[i] = _support(candidates.joints_px[i], of_frame[int(frame)])
    return candidates.take(np.argsort(candidates.frame, kind="stable"))


def _support(joints_px: np.ndarray, palms: Palms) -> float:
    """Return the score of the best palm with the place and size of a hand's joints."""
    size = float(spread(joints_px[None])[0])
    away = np.linalg.norm(palms.boxes_px[:, :2] - joints_px[_PALM].mean(0), axis=-1)
    ratio = palms.boxes_px[:, 2:].max(1) / max(size, 1e-6)
    fits = (away < 0.6 * size) & (ratio > 0.5) & (ratio < 2)
    return float(palms.score[fits].max(initial=0))


def _find_palms(
    frames: np.ndarray, networks: HandNetworks, searched: np.ndarray, min_palm: float
) -> list[Palms]:
    """Return the palms of each searched frame."""
    tiles = make_tiles(*frames.shape[1:3])
    palms = []
    for frame in searched:
        outputs = [networks.palms(cut_tile(frames[frame], tile)) for tile in tiles]
        boxes, logits = (np.stack(values) for values in zip(*outputs, strict=True))
        palms.append(decode_palms(boxes, logits, tiles, min_score=min_palm))
    return palms


def find_joints(
    frames: np.ndarray,
    networks: HandNetworks,
    numbers: np.ndarray,
    regions: Regions,
    min_presence: float,
) -> Candidates:
    """Return the confident detections of the landmark network in regions of frames."""
    crop, meters = np.zeros((2, len(numbers), 21, 3))
    presence, right = np.zeros((2, len(numbers)))
    for i, frame in enumerate(numbers):
        image = crop_region(frames[frame], regions, i)
        crop[i], presence[i], right[i], meters[i] = networks.landmarks(image)
    candidates = Candidates(
        frame=numbers,
        joints_px=joints_in_image(regions, crop[..., :2]),
        joints_hand_m=unrotate(regions, meters),
        presence=presence,
        right=right,
        bend_right=right_by_bend(meters),
        palm=np.zeros(len(numbers)),
        again=np.zeros(len(numbers), bool),
        forearm_right=np.full(len(numbers), 0.5),
    )
    return candidates.take(presence >= min_presence)


def _refined(
    frames: np.ndarray,
    networks: HandNetworks,
    candidates: Candidates,
    min_presence: float,
    same_hand: float,
) -> Candidates:
    """Return candidates averaged with a second detection in the region of their keypoints."""
    again = find_joints(
        frames, networks, candidates.frame, regions_of_joints(candidates.joints_px), 0.0
    )
    same = relative_distance(again.joints_px, candidates.joints_px) <= same_hand
    sure = np.flatnonzero(same & (again.presence >= min_presence))
    values = {}
    for name in ("joints_px", "joints_hand_m", "presence", "right", "bend_right"):
        values[name] = getattr(candidates, name).copy()
        values[name][sure] = (values[name][sure] + getattr(again, name)[sure]) / 2
    return replace(candidates, **values)


def _followed(
    fresh: Candidates, candidates: Candidates, allowed: np.ndarray, same_hand: float
) -> Candidates:
    """Return fresh candidates moved to adjacent frames, where no hand is near them yet."""
    both = fresh.join(fresh)
    frame = np.concatenate([fresh.frame - 1, fresh.frame + 1])
    inside = (frame >= 0) & (frame < len(allowed))
    inside &= allowed[np.clip(frame, 0, len(allowed) - 1)]
    moved = replace(both, frame=frame).take(inside)
    return _new_ones(moved, candidates, same_hand)


def _once(candidates: Candidates, same_hand: float) -> Candidates:
    """Return candidates without duplicates of a more confident one (non-maximum suppression)."""
    order = np.argsort(-candidates.presence, kind="stable")
    kept: list[int] = []
    by_frame: dict[int, list[int]] = {}
    for i in order:
        others = by_frame.setdefault(int(candidates.frame[i]), [])
        near = relative_distance(candidates.joints_px[i : i + 1], candidates.joints_px[others])
        if not len(others) or near.min() > same_hand:
            others.append(i)
            kept.append(i)
    return candidates.take(np.sort(np.array(kept, int)))


def _new_ones(candidates: Candidates, old: Candidates, same_hand: float) -> Candidates:
    """Return the candidates that are not a hand already found in their frame."""
    order = np.argsort(old.frame, kind="stable")
    starts = np.searchsorted(old.frame[order], candidates.frame)
    stops = np.searchsorted(old.frame[order], candidates.frame, side="right")
    new = np.ones(len(candidates), bool)
    for i, (start, stop) in enumerate(zip(starts, stops, strict=True)):
        there = old.joints_px[order[start:stop]]
        near = relative_distance(candidates.joints_px[i : i + 1], there)
        new[i] = not len(there) or near.min() > same_hand
    return candidates.take(new)
