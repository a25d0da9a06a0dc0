"""A wearer's own hand: calibration, mapping, pinch, and frames without a hand."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from egosim_jax.interactive.play.moves import Pose
from egosim_jax.interactive.play.own_hand import CALIBRATE_S, HOLD_S, OwnHand, steps_towards
from tests.own_hands import RATE, Wearer

WEARER = cv2.Rodrigues(np.array([-2.2, 0.1, 0.0]))[0]
"""Rotation of a camera on the head, which looks down."""


def calibrated(facing):
    """A calibrated hand, the person, and the time of the next frame."""
    hand = OwnHand("right", WEARER)
    person, time_s = Wearer(hand.home, WEARER, facing=facing), 0.0
    while hand.phase == "calibrate" and time_s < 3:
        hand.see(person.joints(hand.home), time_s)
        time_s += 1 / RATE
    assert hand.phase == "follow"
    return hand, person, time_s


@pytest.mark.parametrize("facing", [False, True])
def test_a_hand_moves_and_turns_as_the_persons_does(facing):
    hand, person, time_s = calibrated(facing)
    assert CALIBRATE_S <= time_s <= CALIBRATE_S + 0.2
    turn = cv2.Rodrigues(np.array([0.3, -0.2, 0.4]))[0]
    wanted = replace(
        hand.home,
        point_m=hand.home.point_m + [0.1, -0.08, 0.05],
        rotation=turn @ hand.home.rotation,
    )
    seen = hand.see(person.joints(wanted), time_s)
    np.testing.assert_allclose(seen.point_m, wanted.point_m, atol=1e-6)
    np.testing.assert_allclose(seen.rotation, wanted.rotation, atol=1e-6)


def test_a_moving_hand_is_not_calibrated():
    hand = OwnHand("right", WEARER)
    person = Wearer(hand.home, WEARER, facing=True)
    for number in range(60):
        way = [0.3 * np.sin(number / 5), 0, 0]
        moved = replace(hand.home, point_m=hand.home.point_m + way)
        assert hand.see(person.joints(moved), number / RATE) is hand.home
    assert hand.phase == "calibrate"


def test_a_fist_is_not_calibrated():
    hand = OwnHand("right", WEARER)
    person = Wearer(hand.home, WEARER, facing=True)
    for number in range(40):
        hand.see(person.joints(hand.home, pinches=True), number / RATE)
    assert hand.phase == "calibrate"


def test_a_pinch_has_a_hysteresis():
    hand, person, time_s = calibrated(True)

    def opened_by(ratio):
        joints = person.joints(hand.home).copy()
        palm = np.linalg.norm(joints[9] - joints[0])
        joints[8] = joints[4] + [ratio * palm, 0, 0]
        hand.see(joints, time_s)
        return hand.pinches

    pinches = [opened_by(ratio) for ratio in (0.9, 0.5, 0.4, 0.5, 0.58, 0.65, 0.5)]
    assert pinches == [False, False, True, True, True, False, False]


def test_a_lost_hand_holds_then_opens_and_retreats_then_follows_again():
    hand, person, time_s = calibrated(True)
    there = replace(hand.home, point_m=hand.home.point_m + [0.1, 0.05, 0.0])
    last = hand.see(person.joints(there, pinches=True), time_s)
    assert hand.pinches
    held = hand.see(None, time_s + HOLD_S - 0.01)
    assert (hand.phase, hand.pinches) == ("hold", True)
    np.testing.assert_array_equal(held.point_m, last.point_m)
    assert hand.see(None, time_s + HOLD_S + 0.01) is hand.home
    assert (hand.phase, hand.pinches) == ("retreat", False)
    again = hand.see(person.joints(there), time_s + 2)
    assert hand.phase == "follow"
    np.testing.assert_allclose(again.point_m, there.point_m, atol=1e-6)


def test_mirrored_joints_do_not_turn_the_hand():
    hand, person, time_s = calibrated(True)
    joints = person.joints(hand.home)
    center = joints.mean(axis=0)
    mirrored = center + (joints - center) * [-1, 1, 1]
    seen = hand.see(mirrored, time_s)
    np.testing.assert_allclose(seen.rotation, hand.home.rotation, atol=1e-6)


def test_the_speed_of_a_hand_is_limited():
    home = OwnHand("right", WEARER).home
    turn = cv2.Rodrigues(np.array([0.0, 0.0, 1.5]))[0]
    far = Pose(point_m=home.point_m + [0.5, 0, 0], rotation=turn @ home.rotation, closure=0.6)
    step = steps_towards(home, far, 0.1)
    assert np.linalg.norm(step.point_m - home.point_m) == pytest.approx(0.1)
    angle = np.linalg.norm(cv2.Rodrigues(step.rotation @ home.rotation.T)[0])
    assert angle == pytest.approx(0.6)
    assert step.closure - home.closure == pytest.approx(0.25)
    assert steps_towards(home, far, 10.0).closure == far.closure
