"""The five stages, each with a thing that it alone decides about."""

import numpy as np
import pytest

from egosim_jax.state.filter import from_arrays, gone, is_hand, is_held, overlap, to_arrays, touched

NAMES = {1: "red cup", 2: "handle"}


def scene(frames=3):
    """A hand over a corner of thing 1; thing 2 far from both."""
    ids = np.zeros((frames, 20, 30), np.int32)
    ids[:, 4:12, 4:12] = 1
    ids[:, 14:19, 22:28] = 2
    ids[:, 2:8, 6:16] = -1
    depth = np.full(ids.shape, 0.6, np.float32)
    return ids, depth


def test_hands_are_told_by_whole_words():
    assert all(map(is_hand, ["hand", "left arm", "Person", "two hands"]))
    assert not any(map(is_hand, ["handle", "armchair", "red cup in hand"]))
    assert is_held("red cup in hand")


def test_the_thing_under_the_hand_is_touched_and_the_other_is_not():
    found = touched(*scene(), NAMES)
    assert set(found) == {1}
    assert found[1].all()


def test_a_held_thing_needs_no_hand_beside_it():
    ids, depth = scene()
    found = touched(ids, depth, {1: "red cup", 2: "handle in hand"})
    assert set(found) == {1, 2}


def test_a_thing_called_hand_is_not_a_thing():
    assert not touched(*scene(), {1: "left hand"})


def test_boxes_that_hardly_overlap_do_not_touch():
    ids, depth = scene()
    ids[ids == -1] = 0
    ids[:, 0:5, 6:16] = -1
    assert not touched(ids, depth, NAMES)


@pytest.mark.parametrize(("gap", "near"), [(0.14, True), (0.16, False)])
def test_a_hand_in_front_of_a_thing_far_behind_does_not_touch_it(gap, near):
    ids, depth = scene()
    depth[ids == 1] += gap
    assert bool(touched(ids, depth, NAMES)) is near


def test_unknown_depth_excludes_nothing():
    ids, depth = scene()
    depth[ids == 1] = np.inf
    assert set(touched(ids, depth, NAMES)) == {1}


def test_two_hands_may_touch_one_thing():
    ids, depth = scene()
    ids[:1][ids[:1] == -1] = -2
    ids[2, 6:14, 2:6] = -2
    ids[1][ids[1] == -1] = 0
    np.testing.assert_array_equal(touched(ids, depth, NAMES)[1], [True, True, True])


def test_between_two_touches_a_thing_is_touched():
    ids, depth = scene(5)
    ids[1:4][ids[1:4] == -1] = 0
    found = touched(ids, depth, NAMES)
    np.testing.assert_array_equal(found[1], [True] * 5)
    ids[4][ids[4] == -1] = 0
    found = touched(ids, depth, NAMES)
    np.testing.assert_array_equal(found[1], [True] + [False] * 4)


@pytest.mark.parametrize(
    ("hidden", "lost"), [((2, 3, 4), {1}), ((4,), set()), ((2, 3), set()), ((), set())]
)
def test_what_is_not_seen_again_after_a_touch_is_gone(hidden, lost):
    ids, depth = scene(5)
    ids[2:][ids[2:] == -1] = 0
    for frame in hidden:
        ids[frame][ids[frame] == 1] = 0
    assert gone(ids, touched(ids, depth, NAMES)) == lost


def test_a_thing_touched_in_the_last_but_one_frame_is_not_yet_gone():
    ids, depth = scene(5)
    ids[4] = 0
    assert gone(ids, touched(ids, depth, NAMES)) == set()


def test_overlap_is_intersection_over_union():
    assert overlap((0, 4, 0, 4), (2, 6, 0, 4)) == pytest.approx(8 / 24)
    assert overlap((0, 4, 0, 4), (4, 6, 0, 4)) == 0


@pytest.mark.parametrize("names", [NAMES, {}])
def test_what_was_found_goes_through_plain_arrays(tmp_path, names):
    found = touched(*scene(), names)
    np.savez(tmp_path / "touched.npz", **to_arrays(found))
    with np.load(tmp_path / "touched.npz", allow_pickle=False) as file:
        again = from_arrays(file)
    assert again.keys() == found.keys()
    for number, frames in found.items():
        np.testing.assert_array_equal(again[number], frames)
