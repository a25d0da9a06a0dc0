"""Holds and noise of hands that a test makes itself."""

from __future__ import annotations

import numpy as np

from egosim_jax.dynamics.grips import find_holds
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


def test_a_closed_gripper_keeps_the_direction_of_its_jaws():
    track = track_hand(gripper([0.1, 0.05, 0.0, 0.0, 0.0, 0.05]), "robot")
    assert np.allclose(track.rotation, track.rotation[0])


def test_a_missing_hand_has_no_track():
    assert track_hand(np.full((5, 3, 3), np.nan), "robot") is None
