"""Holds and noise of hands that a test makes itself."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from egosim_jax.dynamics.grips import Hold, find_holds, hand_motion
from egosim_jax.dynamics.hands import track_hand


def gripper(openings, *, along=0.0, noise=0.0, seed=0):
    """Return the joints of a gripper with an opening in each frame, in meters."""
    openings = np.asarray(openings, float)
    wrist = np.stack([np.zeros_like(openings), -0.1 + 0 * openings, 0.3 + 0 * openings], axis=1)
    jaws = [wrist + [0, 0.12, 0] + s * openings[:, None] / 2 * [1, 0, 0] for s in (-1, 1)]
    joints = np.stack([wrist, *jaws], axis=1) + along * np.arange(len(openings))[:, None, None]
    return joints + noise * np.random.default_rng(seed).normal(size=joints.shape)


def test_a_hold_begins_when_the_opening_stays_and_ends_when_it_grows():
    track = track_hand(gripper([0.1, 0.1, 0.09, 0.06, 0.06, 0.06, 0.06, 0.08, 0.1]), "robot")
    closed = [hold for hold in find_holds(track) if hold.closes]
    assert [(hold.begin, hold.end, hold.opens) for hold in closed] == [(3, 6, True)]


def test_a_fist_that_was_always_closed_never_closes():
    track = track_hand(gripper(np.full(9, 0.02), along=0.01), "robot")
    assert not any(hold.closes for hold in find_holds(track))


def test_the_noise_of_a_hand_is_measured_and_exact_hands_have_none():
    openings = np.concatenate([np.full(12, 0.1), np.linspace(0.1, 0.06, 4), np.full(12, 0.06)])
    assert track_hand(gripper(openings), "robot").sigma_m == 0
    noisy = track_hand(gripper(openings, noise=0.003), "robot")
    assert 0.001 < noisy.sigma_m < 0.004


@pytest.mark.parametrize(
    ("seeming", "end"),
    [([0.03] * 4, 18), ([0.06, 0.12, 0.06, 0.06], 18), ([0.12] * 4, 10)],
    ids=["closes further", "one wide frame", "opens"],
)
def test_a_noisy_hand_holds_on_until_it_opens(seeming, end):
    openings = np.concatenate([np.full(4, 0.1), np.full(7, 0.06), seeming, np.full(4, 0.06)])
    track = replace(track_hand(gripper(openings), "robot"), sigma_m=0.003)
    tips = gripper(openings)[:, 1:]  # as they are, without the smoothing of a noisy hand
    hold = next(h for h in find_holds(replace(track, tips_m=tips)) if h.closes)
    assert (hold.begin, hold.end) == (4, end)


def turning(angles_deg):
    """Return a noisy track of a hand that turns about the vertical, and a hold of all frames."""
    track = replace(track_hand(gripper(np.full(len(angles_deg), 0.06)), "robot"), sigma_m=0.003)
    turns = np.stack([cv2.Rodrigues(np.radians([0.0, 0.0, a]))[0] for a in angles_deg])
    last = len(angles_deg) - 1
    hold = Hold(begin=0, steady=last, end=last, closes=True, opens=False)
    return replace(track, rotation=turns @ track.rotation), hold


@pytest.mark.parametrize(
    ("angles_deg", "last_deg"),
    [
        ([0, 15, -4, 12, 8, -6, 10, 5, 45, 80], 0.0),  # the last two frames are outliers
        ([70, 3, -2, 4, 6, -5, 3, 5, 2, 4], 0.0),  # the first one is
        (np.linspace(0, 90, 10), 90.0),
    ],
)
def test_a_noisy_hand_turns_an_object_only_if_it_clearly_turns(angles_deg, last_deg):
    track, hold = turning(angles_deg)
    motion = hand_motion(track, hold, track.pinch_m[0], np.array([0.0, 0.0, 1.0]))
    turned = np.degrees(np.arctan2(motion[-1, 1, 0], motion[-1, 0, 0]))
    assert np.isclose(turned, last_deg, atol=1e-6)
    assert np.allclose(motion[0], np.eye(4))


def test_a_closed_gripper_keeps_the_direction_of_its_jaws():
    track = track_hand(gripper([0.1, 0.05, 0.0, 0.0, 0.0, 0.05]), "robot")
    assert np.allclose(track.rotation, track.rotation[0])


def test_a_missing_hand_has_no_track():
    assert track_hand(np.full((5, 3, 3), np.nan), "robot") is None
