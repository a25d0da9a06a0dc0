"""A hand in the frames of a camera: found, followed, lifted, smoothed and lost."""

import numpy as np
import pytest

from egosim_jax.perception.video.hands.live import (
    PALM_M,
    LiveHand,
    OneEuro,
    lifted_hand,
    palm_length,
)
from tests.hands import PaintedHands, hand_px, paint


class Counted(PaintedHands):
    """Networks that count the searches of palms."""

    searches = 0

    def palms(self, image):
        self.searches += 1
        return super().palms(image)


def test_a_hand_is_searched_once_and_then_followed_until_it_is_lost():
    hands = [[hand_px(center=(150 + 2 * n, 120))] for n in range(6)]
    networks = Counted()
    live = LiveHand(networks, "right")
    frames = paint([*hands, []])
    for number, frame in enumerate(frames[:-1]):
        joints = live.see(frame, number / 30)
        assert palm_length(joints) == pytest.approx(PALM_M, rel=0.05)
        np.testing.assert_allclose(live.joints_px, hands[number][0], atol=3)
    assert networks.searches <= 2
    assert live.see(frames[-1], 0.3) is None
    assert live.joints_px is None
    assert live.see(frames[0], 0.4) is not None


def test_a_hand_of_twice_the_size_is_half_as_far():
    shape = np.concatenate([hand_px(center=(0, 0)) / 1000, np.zeros((21, 1))], axis=1)
    far, near = (
        lifted_hand(hand_px(center=(200, 100), size=size), shape, (240, 320)) for size in (0.5, 1)
    )
    assert far[:, 2].mean() == pytest.approx(2 * near[:, 2].mean(), rel=0.02)


def test_a_filter_smooths_a_resting_point_more_than_a_fast_one():
    noise = np.random.default_rng(0).normal(0, 0.002, (60, 1, 3))
    resting, fast = OneEuro(cutoff_hz=1.0, beta=4.0), OneEuro(cutoff_hz=1.0, beta=4.0)
    still = np.stack([resting(point, n / 30) for n, point in enumerate(noise)])
    assert still[30:].std() < 0.6 * noise[30:].std()
    moved = np.stack([fast(np.full((1, 3), n / 30), n / 30) for n in range(60)])
    assert np.abs(moved[30:] - np.arange(30, 60)[:, None, None] / 30).max() < 0.05
