"""The stages of the interaction filter, each on a case that it alone decides."""

import numpy as np
import pytest

from egosim_jax.state.filter import (
    box_iou,
    disappeared_objects,
    interacted_frames,
    is_hand,
    is_held,
)

NAMES = {1: "red cup", 2: "handle"}


def scene(frames=3):
    """A hand over a corner of object 1; object 2 far from both."""
    ids = np.zeros((frames, 20, 30), np.int32)
    ids[:, 4:12, 4:12] = 1
    ids[:, 14:19, 22:28] = 2
    ids[:, 2:8, 6:16] = -1
    depth = np.full(ids.shape, 0.6, np.float32)
    return ids, depth


def test_hands_are_recognized_by_whole_words():
    assert all(map(is_hand, ["hand", "left arm", "Person", "two hands"]))
    assert not any(map(is_hand, ["handle", "armchair", "red cup in hand"]))
    assert is_held("red cup in hand")


def test_only_the_object_under_the_hand_is_interacted_with():
    found = interacted_frames(*scene(), NAMES)
    assert set(found) == {1}
    assert found[1].all()


def test_a_held_object_needs_no_hand_near_it():
    ids, depth = scene()
    found = interacted_frames(ids, depth, {1: "red cup", 2: "handle in hand"})
    assert set(found) == {1, 2}


def test_a_hand_is_not_an_object():
    assert not interacted_frames(*scene(), {1: "left hand"})


def test_boxes_that_hardly_overlap_do_not_interact():
    ids, depth = scene()
    ids[ids == -1] = 0
    ids[:, 0:5, 6:16] = -1
    assert not interacted_frames(ids, depth, NAMES)


@pytest.mark.parametrize(("gap", "near"), [(0.14, True), (0.16, False)])
def test_a_hand_far_in_front_of_an_object_does_not_interact(gap, near):
    ids, depth = scene()
    depth[ids == 1] += gap
    assert bool(interacted_frames(ids, depth, NAMES)) is near


def test_unknown_depth_excludes_nothing():
    ids, depth = scene()
    depth[ids == 1] = np.inf
    assert set(interacted_frames(ids, depth, NAMES)) == {1}


def test_two_hands_may_interact_with_one_object():
    ids, depth = scene()
    ids[:1][ids[:1] == -1] = -2
    ids[2, 6:14, 2:6] = -2
    ids[1][ids[1] == -1] = 0
    np.testing.assert_array_equal(interacted_frames(ids, depth, NAMES)[1], [True, True, True])


def test_gaps_between_two_interactions_are_filled():
    ids, depth = scene(5)
    ids[1:4][ids[1:4] == -1] = 0
    found = interacted_frames(ids, depth, NAMES)
    np.testing.assert_array_equal(found[1], [True] * 5)
    ids[4][ids[4] == -1] = 0
    found = interacted_frames(ids, depth, NAMES)
    np.testing.assert_array_equal(found[1], [True] + [False] * 4)


@pytest.mark.parametrize(
    ("hidden", "lost"), [((2, 3, 4), {1}), ((4,), set()), ((2, 3), set()), ((), set())]
)
def test_an_object_invisible_after_its_interaction_has_disappeared(hidden, lost):
    ids, depth = scene(5)
    ids[2:][ids[2:] == -1] = 0
    for frame in hidden:
        ids[frame][ids[frame] == 1] = 0
    assert disappeared_objects(ids, interacted_frames(ids, depth, NAMES)) == lost


def test_one_invisible_frame_is_not_a_disappearance():
    ids, depth = scene(5)
    ids[4] = 0
    assert disappeared_objects(ids, interacted_frames(ids, depth, NAMES)) == set()


def test_box_iou_is_intersection_over_union():
    assert box_iou((0, 0, 4, 4), (0, 2, 4, 6)) == pytest.approx(8 / 24)
    assert box_iou((0, 0, 4, 4), (0, 4, 4, 6)) == 0
