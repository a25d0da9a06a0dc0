"""Tracks of synthetic candidates: crossing hands, duplicates, gaps, wrong sides."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.perception.video.estimates import LEFT, RIGHT, HandEstimator
from egosim_jax.perception.video.hands import LandmarkHands
from egosim_jax.perception.video.hands.detect import Candidates
from egosim_jax.perception.video.hands.estimator import paint_skin
from egosim_jax.perception.video.hands.track import (
    TrackConfig,
    choose_tracks,
    fill_gaps,
    find_gaps,
    smooth,
    smoothing,
)
from tests.hands import PaintedHands, hand_px, paint


def candidates(*hands, forearm=0.5, bend=0.5, again=False):
    """Return candidates of (frame, center, probability of a right hand, presence, palm)."""
    frame, centers, right, presence, palm = zip(*hands, strict=True)
    joints = np.array([hand_px(center=center) for center in centers])
    return Candidates(
        frame=np.array(frame),
        joints_px=joints,
        joints_hand_m=np.concatenate([joints, 0 * joints[..., :1]], -1) * 0.001,
        presence=np.array(presence, float),
        right=np.array(right, float),
        palm=np.array(palm, float),
        forearm_right=np.broadcast_to(np.asarray(forearm, float), (len(hands),)),
        again=np.broadcast_to(again, (len(hands),)),
        bend_right=np.broadcast_to(np.asarray(bend, float), (len(hands),)),
    )


def chosen(found, frames, **options):
    return choose_tracks(found, frames, TrackConfig(**options), same_hand=0.4)


def test_each_hand_has_the_side_that_the_network_says():
    found = candidates(
        *[(f, (100, 100), 0.1, 0.9, 0.9) for f in range(4)],
        *[(f, (300, 100), 0.9, 0.9, 0.9) for f in range(4)],
    )
    assert chosen(found, 4).tolist() == [[f, 4 + f] for f in range(4)]


def test_a_side_that_is_wrong_in_a_few_frames_does_not_break_a_track():
    right = [0.9, 0.9, 0.3, 0.1, 0.9, 0.9, 0.8, 0.9]
    found = candidates(*[(f, (100 + 5 * f, 100), r, 0.9, 0.9) for f, r in enumerate(right)])
    path = chosen(found, 8)
    assert path[:, RIGHT].tolist() == list(range(8))
    assert (path[:, LEFT] == -1).all()


def test_a_hand_whose_forearm_enters_from_the_right_is_a_right_one():
    hands = [(f, (100, 100), 0.2, 0.9, 0.9) for f in range(6)]
    assert (chosen(candidates(*hands), 6)[:, LEFT] >= 0).all()
    assert (chosen(candidates(*hands, forearm=0.95), 6)[:, RIGHT] >= 0).all()


def test_the_detection_whose_fingers_bend_as_on_its_side_is_chosen():
    hands = [(f, (100 + d, 100), 0.6, 0.9, 0.9) for d in (0, 30) for f in range(6)]
    found = candidates(*hands, forearm=0.95, bend=[0.05] * 6 + [0.95] * 6)
    assert chosen(found, 6)[:, RIGHT].tolist() == list(range(6, 12))


def test_other_joints_of_a_hand_are_not_a_second_hand():
    hands = [(f, (100 + d, 100), r, 0.9, 0.9) for d, r in ((0, 0.9), (90, 0.1)) for f in range(6)]
    assert (chosen(candidates(*hands), 6) >= 0).all()
    path = chosen(candidates(*hands, again=[False] * 6 + [True] * 6), 6)
    assert path[:, RIGHT].tolist() == list(range(6))
    assert (path[:, LEFT] == -1).all()


def test_hands_that_cross_keep_their_sides():
    places = np.linspace(60, 340, 15)
    found = candidates(
        *[(f, (x, 100), 0.2, 0.9, 0.9) for f, x in enumerate(places)],
        *[(f, (400 - x, 170), 0.7, 0.9, 0.9) for f, x in enumerate(places)],
    )
    path = chosen(found, 15)
    assert path[:, LEFT].tolist() == list(range(15))
    assert path[:, RIGHT].tolist() == list(range(15, 30))


def test_one_hand_that_was_found_twice_is_one_hand():
    found = candidates(
        *[(f, (100, 100), 0.9, 0.9, 0.9) for f in range(6)],
        *[(f, (120, 108), 0.1, 0.8, 0.9) for f in range(6)],
    )
    path = chosen(found, 6)
    assert path[:, RIGHT].tolist() == list(range(6))
    assert (path[:, LEFT] == -1).all()


def test_a_gap_stays_a_gap():
    found = candidates(*[(f, (100, 100), 0.9, 0.9, 0.9) for f in range(12) if not 4 <= f < 8])
    path = chosen(found, 12)
    assert (path[4:8] == -1).all()
    assert (path[[0, 1, 2, 3, 8, 9, 10, 11], RIGHT] >= 0).all()


def test_a_hand_in_only_one_frame_is_dropped():
    found = candidates((5, (100, 100), 0.9, 0.9, 0.9))
    assert (chosen(found, 12) == -1).all()


def test_a_candidate_without_a_palm_loses_to_one_with_a_palm():
    found = candidates(
        *[(f, (100, 100), 0.95, 0.95, 0) for f in range(6)],
        *[(f, (300, 100), 0.85, 0.85, 0.9) for f in range(6)],
    )
    assert chosen(found, 6, side=2.0)[:, RIGHT].tolist() == list(range(6, 12))


def test_a_track_with_rarely_detected_palms_is_dropped():
    palms = [0.9] + [0] * 9
    found = candidates(*[(f, (100, 100), 0.9, 0.9, palm) for f, palm in enumerate(palms)])
    assert (chosen(found, 10) == -1).all()
    assert (chosen(found, 10, min_palms=0.1)[:, RIGHT] >= 0).all()


def test_without_candidates_there_are_no_tracks():
    nothing = candidates((0, (0, 0), 0, 0, 0)).take(np.zeros(0, int))
    assert (chosen(nothing, 3) == -1).all()


def moving(frames=9, missing=()):
    joints = np.full((frames, 2, 21, 2), np.nan)
    for f in set(range(frames)) - set(missing):
        joints[f, RIGHT] = hand_px(center=(100 + 3 * f, 100))
    return joints


def test_only_short_gaps_with_two_ends_are_found():
    gaps = find_gaps(moving(missing=[0, 2, 3, 8]), max_gap=2, max_motion=1.0)
    assert np.flatnonzero(gaps[:, RIGHT]).tolist() == [2, 3]
    assert not gaps[:, LEFT].any()
    assert not find_gaps(moving(missing=[2, 3, 4]), max_gap=2, max_motion=1.0).any()
    assert not find_gaps(moving(missing=[2, 3]), max_gap=2, max_motion=0.01).any()


def test_a_filled_gap_is_straight_motion():
    broken = moving(missing=[2, 3, 7])
    gaps = find_gaps(broken, max_gap=2, max_motion=1.0)
    np.testing.assert_allclose(fill_gaps(broken, gaps), moving(), atol=1e-9)


def smoothed(joints_px):
    return smooth(joints_px, smoothing(joints_px, max_motion=0.5))


def test_smoothing_keeps_straight_motion_and_reduces_noise_but_crosses_no_gap():
    straight = moving(missing=[4])
    np.testing.assert_allclose(smoothed(straight)[1:8], straight[1:8], atol=1.6)
    np.testing.assert_allclose(smoothed(straight)[1:3], straight[1:3], atol=1e-9)
    np.testing.assert_array_equal(np.isnan(smoothed(straight)), np.isnan(straight))
    still = np.tile(hand_px(center=(0, 0)), (400, 2, 1, 1))
    noise = np.random.default_rng(0).normal(0, 1, still.shape)
    assert (smoothed(still + noise) - still)[1:-1].std() == pytest.approx(np.sqrt(6) / 4, rel=0.02)


def test_a_mirrored_hand_is_not_mixed_with_its_neighbors():
    joints = moving()
    joints[4, RIGHT, :, 0] = 300 - joints[4, RIGHT, :, 0]
    np.testing.assert_allclose(smoothed(joints)[4], joints[4])
    np.testing.assert_allclose(smoothed(joints)[2], joints[2])


def test_a_painted_video_has_its_hand_on_its_side_and_its_gap_is_marked():
    hands = [[hand_px(center=(150 + 3 * f, 120))] for f in range(9)]
    hands[4] = []
    estimator = LandmarkHands(networks=PaintedHands())
    assert isinstance(estimator, HandEstimator)
    tracks = estimator(paint(hands, right=False))
    assert (tracks.presence[:, LEFT] > 0).tolist() == [f != 4 for f in range(9)]
    assert np.flatnonzero(tracks.filled[:, LEFT]).tolist() == [4]
    assert np.isnan(tracks.joints_px[:, RIGHT]).all()
    assert not tracks.mirrored.any()
    expected = [hand_px(center=(150 + 3 * f, 120)) for f in range(9)]
    np.testing.assert_allclose(tracks.joints_px[1:8, LEFT], expected[1:8], atol=1)
    honest = replace(estimator, max_gap=0)(paint(hands, right=False))
    assert np.isnan(honest.joints_px[4]).all()


def test_large_frames_are_searched_smaller_and_found_in_their_own_pixels():
    frames = paint([[hand_px(center=(150, 120))]] * 3)
    large = frames.repeat(2, axis=1).repeat(2, axis=2)
    tracks = LandmarkHands(networks=PaintedHands(), max_side=320)(large)
    expected = 2 * (hand_px(center=(150, 120)) + 0.5) - 0.5
    np.testing.assert_allclose(tracks.joints_px[:, RIGHT], np.tile(expected, (3, 1, 1)), atol=1.5)


def test_gloves_are_painted_in_the_color_of_skin_as_bright_as_they_were():
    blue = np.zeros((1, 2, 2, 3), np.uint8)
    blue[..., 2] = 255
    painted = paint_skin(blue).astype(int)
    assert (painted[..., 0] > painted[..., 1]).all()
    assert (painted[..., 1] > painted[..., 2]).all()
    assert not paint_skin(np.zeros((1, 2, 2, 3), np.uint8)).any()
