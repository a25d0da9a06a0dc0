"""Stages of an annotation."""

from fractions import Fraction

import numpy as np
import pytest

from egosim_jax.annotate.prepare import RefusedError
from egosim_jax.annotate.scene import check_prior
from egosim_jax.annotate.stages import drop_flashes, hold_hands, visible
from egosim_jax.perception.estimates import LEFT, RIGHT
from tests.unit.annotate.stubs import StubHands, config


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


def test_a_prior_that_is_worse_than_the_first_frame_is_refused():
    figures = {"psnr_background": 17.0, "psnr_first_frame": 20.0}
    with pytest.raises(RefusedError, match=r"-3\.0 dB .*\(--min-prior-gain\)"):
        check_prior("incremental", figures, config())
    check_prior("static", figures, config())
    check_prior("incremental", {**figures, "psnr_background": 19.0}, config())


def test_a_second_hand_for_a_moment_is_the_first_one_again():
    hands = StubHands(1.0, None)(np.zeros((60, 48, 80, 3), np.uint8))
    for frames in (slice(10, 14), slice(30, 45)):
        hands.joints_px[frames, LEFT] = hands.joints_px[frames, RIGHT] + 20
        hands.joints_hand_m[frames, LEFT] = hands.joints_hand_m[frames, RIGHT]
    kept = drop_flashes(hands, Fraction(16))
    assert np.flatnonzero(visible(kept)[:, LEFT]).tolist() == list(range(30, 45))
    assert visible(kept)[:, RIGHT].all()
    alone = StubHands(0.05, None)(np.zeros((60, 48, 80, 3), np.uint8))
    assert visible(drop_flashes(alone, Fraction(16))).sum() == 3
