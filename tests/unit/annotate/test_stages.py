"""Stages of an annotation."""

from fractions import Fraction

import numpy as np

from egosim_jax.annotate.stages import hold_hands, visible
from egosim_jax.perception.estimates import RIGHT
from tests.unit.annotate.stubs import StubHands


def test_a_hand_keeps_its_silhouette_for_half_a_second():
    hands = StubHands(0.5, None)(np.zeros((40, 48, 80, 3), np.uint8))
    held = hold_hands(hands, Fraction(16))
    assert visible(hands)[:, RIGHT].sum() == 20
    assert np.flatnonzero(visible(held)[:, RIGHT]).tolist() == list(range(28))
    assert np.array_equal(held.joints_px[27], hands.joints_px[19], equal_nan=True)
    assert not visible(held)[:, 1 - RIGHT].any()


def test_a_video_without_hands_holds_none():
    hands = StubHands(0.0, None)(np.zeros((9, 48, 80, 3), np.uint8))
    assert not visible(hold_hands(hands, Fraction(16))).any()
