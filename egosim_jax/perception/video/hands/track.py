"""Tracks of at most one left and one right hand, chosen among the candidates of all frames.

A state of a frame is a pair of different candidates, one for the left and one for the right hand;
either may be missing. Dynamic programming finds the sequence of states with minimum cost:

    in each frame         the network's doubt in presence and side, a missing hand, and two hands
                          at nearly the same place
    from frame to frame   the distance of a hand's motion in hand sizes, or its appearance or
                          disappearance

While fingers are hidden, the network's side is often wrong at high confidence. So a second pass
assigns the sides. Its candidates are at the places of the hands that the first pass found. Its cost
also has the doubt in the side from which the forearm enters, and in the bend of the fingers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from egosim_jax.perception.video.estimates import LEFT, RIGHT
from egosim_jax.perception.video.hands.detect import Candidates, relative_distance


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """Costs of tracking; costs from probabilities are in nats."""

    side: float = 0.5
    """Weight of the network's doubt in the side (left or right)."""
    forearm: float = 1.0
    """Weight of the doubt in the side from which the forearm enters, in the second pass."""
    bend: float = 0.5
    """Weight of the doubt in the side by the bend of the fingers, in the second pass."""
    min_side: float = 0.05
    """Minimum probability of a side, because the network is also confident when wrong."""
    presence: float = 1.0
    """Weight of the doubt in presence."""
    palm: float = 0.5
    """Weight of the doubt in the palm, which need not be detected in every frame."""
    missing: float = 3.5
    """Cost of a missing hand in a frame."""
    change: float = 2.0
    """Cost of the appearance or disappearance of a hand."""
    overlap: float = 8.0
    """Cost of two hands at the same place."""
    apart: float = 0.8
    """Distance of two hands, in hand sizes, at which `overlap` has fallen to zero."""
    motion: float = 3.0
    """Cost of a motion by one hand size between two frames."""
    max_break: int = 3
    """Maximum number of missing frames after which a nearby hand is the same one."""
    max_motion: float = 1.0
    """Maximum motion in hand sizes; beyond it, one hand disappears and another appears."""
    min_frames: int = 3
    """Minimum number of frames of a track; shorter tracks are false detections."""
    min_palms: float = 0.2
    """Minimum fraction of a track's frames with a detected palm."""
    max_candidates: int = 6
    """Maximum number of candidates in a frame; the most confident ones are kept."""


def choose_tracks(
    candidates: Candidates, frames: int, config: TrackConfig, *, same_hand: float
) -> Int[np.ndarray, "f 2"]:
    """Return the candidate indices of the left and right hand in each frame, or -1."""
    first = replace(config, forearm=0.0, bend=0.0)
    path = _choose(candidates, ~candidates.again, frames, first, same_hand)
    path = _without_false(candidates, path, config)
    near = _near_chosen(candidates, path, config)
    return _choose(candidates, near, frames, config, same_hand, (path >= 0).sum(1))


def _choose(
    candidates: Candidates,
    allowed: np.ndarray,
    frames: int,
    config: TrackConfig,
    same_hand: float,
    hands: np.ndarray | None = None,
) -> np.ndarray:
    """Return the path of minimum cost among the allowed candidates, each hand on one side."""
    index = np.flatnonzero(allowed)
    path = _cheapest(candidates.take(index), frames, config, same_hand, hands)
    return _of_one_side(candidates, np.where(path >= 0, np.append(index, -1)[path], -1), config)


def _cheapest(
    candidates: Candidates,
    frames: int,
    config: TrackConfig,
    same_hand: float,
    hands: np.ndarray | None = None,
) -> np.ndarray:
    """Return the states of minimum cost; `hands` is the number of hands in each frame, if known."""
    per_frame = [_best(candidates, frame, config.max_candidates) for frame in range(frames)]
    states = [_pairs(candidates, there, same_hand) for there in per_frame]
    if hands is not None:
        states = [s[(s >= 0).sum(1) == n] for s, n in zip(states, hands, strict=True)]
    cost = _state_cost(candidates, states[0], config)
    back: list[np.ndarray] = []
    for before, now in pairwise(states):
        step = sum(
            _step_cost(candidates, before[:, side], now[:, side], config) for side in (LEFT, RIGHT)
        )
        total = cost[:, None] + step
        back.append(total.argmin(0))
        cost = total.min(0) + _state_cost(candidates, now, config)
    chosen = [int(cost.argmin())]
    for pointers in reversed(back):
        chosen.append(int(pointers[chosen[-1]]))
    return np.array([s[i] for s, i in zip(states, reversed(chosen), strict=True)])


def _near_chosen(candidates: Candidates, path: np.ndarray, config: TrackConfig) -> np.ndarray:
    """Return True for candidates at the place of a chosen candidate of their frame."""
    near = np.zeros(len(candidates), bool)
    for side in (LEFT, RIGHT):
        pairs = np.stack([np.arange(len(candidates)), path[candidates.frame, side]], axis=-1)
        there = np.flatnonzero(pairs[:, 1] >= 0)
        near[there] |= _apart(candidates, pairs[there]) < config.apart
    return near


def _best(candidates: Candidates, frame: int, count: int) -> np.ndarray:
    there = np.flatnonzero(candidates.frame == frame)
    return there[np.argsort(-candidates.presence[there], kind="stable")][:count]


def _pairs(candidates: Candidates, there: np.ndarray, same_hand: float) -> np.ndarray:
    """Return the states of a frame: pairs of candidates, -1 for a missing hand."""
    joints = candidates.joints_px[there]
    same = relative_distance(joints[:, None], joints[None]) < same_hand
    pairs = [(-1, -1)]
    for i, one in enumerate(there):
        pairs += [(one, -1), (-1, one)]
        pairs += [(one, other) for j, other in enumerate(there) if not same[i, j] and i != j]
    return np.array(pairs)


def _state_cost(candidates: Candidates, states: np.ndarray, config: TrackConfig) -> np.ndarray:
    cost = np.zeros(len(states))
    for side in (LEFT, RIGHT):
        there = states[:, side] >= 0
        chosen = states[there, side]
        cost[there] += _side_doubt(candidates, side, config)[chosen]
        cost[there] += config.presence * _nats(candidates.presence[chosen])
        cost[there] += config.palm * _nats(np.clip(candidates.palm[chosen], 0.1, 1))
        cost[~there] += config.missing
    both = (states >= 0).all(1)
    near = np.clip(1 - _apart(candidates, states[both]) / config.apart, 0, None)
    cost[both] += config.overlap * near
    return cost


def _side_doubt(candidates: Candidates, side: int, config: TrackConfig) -> np.ndarray:
    """Return the cost of assigning each candidate to a side."""
    doubt = np.zeros(len(candidates))
    for weight, right in (
        (config.side, np.clip(candidates.right, config.min_side, 1 - config.min_side)),
        (config.forearm, candidates.forearm_right),
        (config.bend, candidates.bend_right),
    ):
        doubt += weight * _nats(right if side == RIGHT else 1 - right)
    return doubt


def _apart(candidates: Candidates, pairs: np.ndarray) -> np.ndarray:
    """Return the distance of two hands' mean joints, in sizes of the larger hand."""
    middle = candidates.joints_px.mean(1)
    apart = np.linalg.norm(middle[pairs[:, LEFT]] - middle[pairs[:, RIGHT]], axis=-1)
    size = candidates.size_px[pairs].max(1)
    return apart / np.maximum(size, 1e-6)


def _step_cost(
    candidates: Candidates, before: np.ndarray, now: np.ndarray, config: TrackConfig
) -> np.ndarray:
    """Return one side's cost of each step from a state to a state of the next frame."""
    earlier, place = np.unique(before, return_inverse=True)
    later, place_now = np.unique(now, return_inverse=True)
    cost = config.change * ((earlier >= 0)[:, None] != (later >= 0)[None]).astype(float)
    i, j = np.flatnonzero(earlier >= 0), np.flatnonzero(later >= 0)
    moved = relative_distance(
        candidates.joints_px[earlier[i], None], candidates.joints_px[None, later[j]]
    )
    jump = 2 * config.change + config.motion * config.max_motion
    cost[np.ix_(i, j)] = np.where(moved > config.max_motion, jump, config.motion * moved)
    return cost[place[:, None], place_now[None]]


def _nats(probability: np.ndarray) -> np.ndarray:
    return -np.log(np.clip(probability, 0.01, 1))


def _of_one_side(candidates: Candidates, path: np.ndarray, config: TrackConfig) -> np.ndarray:
    """Return the path with each hand on one side.

    If a left hand ends where a right hand begins, or the reverse, both are one hand. Its side is
    the one with less doubt over all of its frames.
    """
    path = path.copy()
    odds = _side_doubt(candidates, LEFT, config) - _side_doubt(candidates, RIGHT, config)
    parts = [(start, stop, side) for side in (0, 1) for start, stop in runs(path[:, side] >= 0)]
    for start, stop, side in sorted(parts):
        for begin, end, _ in parts:
            other = 1 - side
            ends_before = 0 <= start - end <= config.max_break and path[begin, other] >= 0
            if not ends_before or path[end - 1, other] < 0 or path[start, side] < 0:
                continue
            if not _in_one_place(candidates, path[end - 1, other], path[start, side], config):
                continue
            earlier, later = path[begin:end, other], path[start:stop, side]
            is_right = odds[earlier].sum() + odds[later].sum() > 0
            wrong = slice(start, stop) if is_right != (side == RIGHT) else slice(begin, end)
            column = side if is_right != (side == RIGHT) else other
            if (path[wrong, 1 - column] < 0).all():
                path[wrong] = path[wrong, ::-1]
    return path


def _in_one_place(candidates: Candidates, one: int, other: int, config: TrackConfig) -> bool:
    """Return True if two hands have nearby mean joints, whatever their sides."""
    pair = candidates.take(np.array([one, other]))
    apart = np.linalg.norm(np.diff(pair.joints_px.mean(1), axis=0))
    return bool(apart < config.max_motion * pair.size_px.max())


def _without_false(candidates: Candidates, path: np.ndarray, config: TrackConfig) -> np.ndarray:
    """Return the path without tracks that are too short or whose palm is rarely detected."""
    path = path.copy()
    for side in (LEFT, RIGHT):
        for start, stop in runs(path[:, side] >= 0):
            joints = candidates.joints_px[path[start:stop, side]]
            moved = relative_distance(joints[1:], joints[:-1])
            cuts = start + 1 + np.flatnonzero(moved > config.max_motion)
            for first, last in zip([start, *cuts], [*cuts, stop], strict=True):
                palms = (candidates.palm[path[first:last, side]] > 0).mean()
                if last - first < min(config.min_frames, len(path)) or palms < config.min_palms:
                    path[first:last, side] = -1
    return path


def fill_gaps(
    joints: Float[np.ndarray, "f 2 21 c"], gaps: Bool[np.ndarray, "f 2"]
) -> Float[np.ndarray, "f 2 21 c"]:
    """Return tracks with straight motion through gaps; both ends of each gap must be known."""
    result = joints.copy()
    for side in (LEFT, RIGHT):
        for start, stop in runs(gaps[:, side]):
            weight = np.arange(1, stop - start + 1)[:, None, None] / (stop - start + 1)
            before, after = joints[start - 1, side], joints[stop, side]
            result[start:stop, side] = (1 - weight) * before + weight * after
    return result


def find_gaps(
    joints_px: Float[np.ndarray, "f 2 21 2"], *, max_gap: int, max_motion: float
) -> Bool[np.ndarray, "f 2"]:
    """Return True in gaps between two hands that are close in time and in the image."""
    missing = np.any(np.isnan(joints_px), axis=(2, 3))
    gaps = np.zeros_like(missing)
    for side in (LEFT, RIGHT):
        for start, stop in runs(missing[:, side]):
            if start == 0 or stop == len(missing) or stop - start > max_gap:
                continue
            moved = relative_distance(joints_px[start - 1 : start, side], joints_px[[stop], side])
            gaps[start:stop, side] = moved[0] <= max_motion
    return gaps


def runs(mask: Bool[np.ndarray, " f"]) -> list[tuple[int, int]]:
    """Return start and stop index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def smoothing(
    joints_px: Float[np.ndarray, "f 2 21 2"], *, max_motion: float
) -> Float[np.ndarray, "f 2 3"]:
    """Return the weights of the previous, current and next frame, at most in the ratio 1 2 1.

    A neighbor has no weight if its hand is missing or more than `max_motion` hand sizes away. So
    no hand is mixed with one that has mirrored joints.
    """
    weights = np.zeros((*joints_px.shape[:2], 3))
    weights[..., 1] = 2
    moved = relative_distance(joints_px[:-1], joints_px[1:])
    weights[1:, :, 0] = weights[:-1, :, 2] = moved <= max_motion
    return weights / weights.sum(-1, keepdims=True)


def smooth(
    joints: Float[np.ndarray, "f 2 21 c"], weights: Float[np.ndarray, "f 2 3"]
) -> Float[np.ndarray, "f 2 21 c"]:
    """Return tracks smoothed over three frames; missing hands stay missing."""
    filled = np.nan_to_num(joints)
    padded = np.concatenate([filled[:1], filled, filled[-1:]])
    parts = [weights[..., i, None, None] * padded[i : i + len(joints)] for i in range(3)]
    return np.where(np.isnan(joints), np.nan, sum(parts))
