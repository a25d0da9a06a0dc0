"""Hands against known shifts and shapes."""

import numpy as np
import pytest

from egosim_jax.evaluation.metrics.hands import hand_iou, hand_recall, hull_mask, keypoint_errors


@pytest.fixture
def target():
    """A square left hand of 20 pixels in two frames; no right hand."""
    hands = np.full((2, 2, 21, 2), np.nan)
    corners = np.array([[10, 10], [30, 10], [30, 30], [10, 30]])
    hands[:, 0] = corners[np.arange(21) % 4]
    return hands


def test_a_shifted_hand_is_off_by_the_shift(target):
    np.testing.assert_allclose(keypoint_errors(target + [3, 4], target), [5.0, 5.0])
    assert hand_recall(target + [3, 4], target) == 1.0


def test_half_shifted_squares_have_an_iou_of_a_third(target):
    # 21 x 21 pixels each; shifted by 10 columns they share 11 of them.
    expected = 11 * 21 / (2 * 21 * 21 - 11 * 21)
    assert hand_iou(target + [10, 0], target, height=80, width=80) == pytest.approx(expected)
    assert hull_mask(target[0], 80, 80).sum() == 21 * 21


def test_a_missing_hand_has_no_area_and_no_keypoints(target):
    found = target.copy()
    found[1] = np.nan
    assert hand_iou(found, target, height=80, width=80) == 0.5
    assert hand_recall(found, target) == 0.5
    assert len(keypoint_errors(found, target)) == 1


def test_a_target_without_hands_has_no_score(target):
    empty = np.full_like(target, np.nan)
    assert np.isnan(hand_iou(target, empty, height=80, width=80))
    assert np.isnan(hand_recall(target, empty))
