"""Objects that a hand moves in a video of a painted box."""

import numpy as np
import pytest

from egosim_jax.perception.video.estimates import HandTracks
from egosim_jax.perception.video.moved import find_moved
from tests.scenes import pinhole
from tests.unit.annotate.stubs import mean_hand, textured_video

HEIGHT, WIDTH, FRAMES = 120, 200, 17
BOX = slice(60, 90), slice(60, 90)
STILL = pinhole(FRAMES, 100.0, HEIGHT, WIDTH)


def painted(steps, *, hand=True):
    """Return frames, masks of the box, and tracks of a hand next to it, both moved by steps."""
    background = textured_video(1, HEIGHT, WIDTH, seed=1)[0] // 2
    texture = 127 + textured_video(1, 30, 30, seed=2)[0] // 2
    frames, shown = np.repeat(background[None], FRAMES, 0), np.zeros((FRAMES, HEIGHT, WIDTH), bool)
    joints = np.full((FRAMES, 2, 21, 2), np.nan)
    for frame, (right, down) in enumerate(steps):
        rows = slice(BOX[0].start + down, BOX[0].stop + down)
        columns = slice(BOX[1].start + right, BOX[1].stop + right)
        frames[frame, rows, columns], shown[frame, rows, columns] = texture, True
        if hand:
            joints[frame, 1] = 150 * mean_hand()[:, :2] + [105 + right, 90 + down]
    meters = np.full((FRAMES, 2, 21, 3), np.nan)
    meters[np.isfinite(joints[..., 0])] = 0
    presence = np.isfinite(joints).all((2, 3)).astype(float)
    tracks = HandTracks(joints_px=joints, joints_hand_m=meters, presence=presence)
    return frames, shown, tracks


def find(frames, tracks, fps=8.0):
    hidden = np.zeros(frames.shape[:3], bool)
    for frame, side in np.argwhere(tracks.presence > 0):
        for x, y in np.rint(tracks.joints_px[frame, side]).astype(int):
            hidden[frame] |= np.hypot(*np.mgrid[-y : HEIGHT - y, -x : WIDTH - x]) < 4
    frames = np.where(hidden[..., None], np.uint8(90), frames)
    depth = np.full((HEIGHT, WIDTH), 1.0)
    return find_moved(frames, hidden, tracks, STILL, depth, fps=fps), hidden


def carried():
    return [(3 * max(0, k - 4), -3 * max(0, k - 4)) for k in range(FRAMES)]


@pytest.fixture(scope="module")
def found():
    frames, shown, tracks = painted(carried())
    moved, hidden = find(frames, tracks)
    return moved, shown, hidden


def overlap(one, other):
    return (one & other).sum() / (one | other).sum()


def test_a_carried_box_is_found_and_followed(found):
    (box,), shown, hidden = found
    assert overlap(box.first, shown[0] & ~hidden[0]) > 0.8
    assert overlap(box.shown[-1], shown[-1]) > 0.7
    corner = box.motion_px[-1] @ [75, 75, 1] - [75, 75]
    np.testing.assert_allclose(corner, carried()[-1], atol=1)
    assert not box.worn


def test_at_a_high_frame_rate_motion_is_interpolated_between_the_frames_that_are_searched():
    frames, shown, tracks = painted(carried())
    (box,), hidden = find(frames, tracks, fps=20.0)
    assert overlap(box.first, shown[0] & ~hidden[0]) > 0.8
    assert box.shown.shape == shown.shape
    assert all(overlap(box.shown[n], shown[n]) > 0.6 for n in (0, FRAMES // 2, FRAMES - 1))
    assert {frame for frame, _ in box.contacts} <= set(range(FRAMES))


def test_a_box_that_moves_without_a_hand_is_not_found():
    frames, _, tracks = painted(carried(), hand=False)
    assert find(frames, tracks)[0] == []


def test_a_hand_that_passes_moves_nothing():
    frames, *_ = painted([(0, 0)] * FRAMES)
    *_, tracks = painted(carried())
    assert find(frames, tracks)[0] == []
