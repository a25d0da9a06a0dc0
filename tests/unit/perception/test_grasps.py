"""Grasps read from joints: frames, objects between the fingertips, and the axis of a hinge."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egosim_jax.geometry import transform
from egosim_jax.perception.grasps import (
    MAX_ENDS,
    Grip,
    complete_hand,
    couplings,
    find_holds,
    hinge_motion,
    is_along_edge,
    is_behind,
    is_between,
    is_firm,
    palm_motion,
    seen_frames,
)

TOLERANCE_M = 0.01


@pytest.mark.parametrize(
    ("opening_cm", "holds"),
    [
        ([7, 8, 9, 5, 4.4, 4.4, 4.4, 4.4, 9, 7], [(3, 7)]),
        ([4, 4, 4, 4, 9, 9.5, 9, 9, 9, 9], [(0, 3)]),
        ([9, 5, 5, 5, 9, 3, 3, 3, 3, 9], [(1, 3), (5, 8)]),
        ([9, 9, 9, 9, 4, 4, 4, 4, 4, 4], [(4, 9)]),
        ([4, 4, 4, 9, 9, 9, 9, 4, 4, 4], [(0, 2), (7, 9)]),
    ],
    ids=[
        "a grasp and a release",
        "held from the start",
        "two grasps",
        "held to the end",
        "an open hand holds nothing",
    ],
)
def test_fingers_hold_while_they_stay_as_far_apart(opening_cm, holds):
    assert find_holds(fingers(opening_cm), TOLERANCE_M) == (holds, True)


@pytest.mark.parametrize(
    ("opening_cm", "count"),
    [([7, 7.4, 7, 7.2, 7], 3 + 2 + 1), ([3, 5, 7, 9, 11], 3 + 2 + 1), ([6, 8, 9.5, 9.5, 9.5], 1)],
    ids=["never closes or opens", "never is steady", "opens and stays open"],
)
def test_a_hand_that_does_not_close_is_less_evidence(opening_cm, count):
    holds, sure = find_holds(fingers(opening_cm), TOLERANCE_M)
    assert len(holds) == count
    assert not sure


def test_a_steady_hand_that_held_something_before_still_holds_it():
    opening_cm = [7, 7.4, 7, 7.2, 7]
    assert find_holds(fingers(opening_cm), TOLERANCE_M, holding=True) == ([(0, 4)], True)
    opened = [4, 4, 4, 9, 9.5, 9]
    assert find_holds(fingers(opened), TOLERANCE_M, holding=True) == ([(0, 2)], True)


@pytest.mark.parametrize(
    ("point_cm", "between"),
    [
        ([3, 0, 0], True),
        ([3, 0.9, 0], True),
        ([3, 1.1, 0], False),
        ([-0.5, 0, 0], False),
        ([6.5, 0, 0], False),
    ],
)
def test_the_grip_is_a_cylinder_between_thumb_and_fingers(point_cm, between):
    (tips,) = fingers([6])
    away = np.array([[0.2, 0.2, 0.2], np.array(point_cm) / 100])
    assert is_between(away, tips, radius_m=0.01) is between


@pytest.mark.parametrize(
    ("width_cm", "in_front_cm", "gripped"),
    [
        (6, 3, True),
        (4, 5, True),
        (2, 3, False),
        (10, 3, True),
        (16, 3, False),
        (6, 8, False),
        (6, -2, False),
    ],
    ids=[
        "its front",
        "smaller",
        "too small",
        "wider",
        "too wide",
        "too far in front",
        "behind the grip",
    ],
)
def test_a_grip_is_inside_an_object_behind_its_front(width_cm, in_front_cm, gripped):
    """A camera above sees the top of a box, which the fingers take further down."""
    (tips,) = fingers([6])
    across = (tips[1:].mean(axis=0) - tips[0]) / 0.06
    up = np.cross(across, [1.0, 0.3, 0.2])
    up /= np.linalg.norm(up)
    along = np.linspace(-width_cm / 200, width_cm / 200, 9)
    middle = (tips[0] + tips[1:].mean(axis=0)) / 2
    top = middle + along[:, None] * across + in_front_cm / 100 * up
    assert is_behind(top, tips, middle + 0.5 * up, radius_m=0.012) is gripped


def test_a_hinge_turns_a_held_object_about_its_axis():
    """The fingertips hold a handle while it turns by 80 degrees, and then leave it."""
    axis = np.array([1.0, 0.2, 0]) / np.linalg.norm([1, 0.2, 0])
    point = np.array([0.1, 0.5, 0.3])
    true = np.stack([turn(axis, point, angle) for angle in np.radians(np.linspace(0, 80, 8))])
    tips = np.array([[0.1, 0.4, 0.31], [0.1, 0.41, 0.30], [0.11, 0.41, 0.29]])
    held = np.stack([transform(motion, tips) for motion in true])
    path = np.concatenate([held[:1] + [0, 0, 0.1], held, held[-1:] + [0, -0.1, 0]])
    found = hinge_motion(path, (1, 8))
    np.testing.assert_allclose(found[1:9], true, atol=1e-9)
    np.testing.assert_array_equal(found[0], np.eye(4))
    np.testing.assert_array_equal(found[9], found[8])
    along = axis * np.linspace(-0.1, 0.1, 9)[:, None]
    lid = point + along + np.cross(axis, [0, 0, 1]) * 0.12 * np.array([[0.1], [0.5], [1]])[:, None]
    assert is_along_edge(lid.reshape(-1, 3), found)
    assert not is_along_edge(lid.reshape(-1, 3) + [0, -0.05, 0], found)


@pytest.mark.parametrize("bend_m", [0.0, 0.01])
def test_a_straight_path_has_no_hinge(bend_m):
    tips = fingers([3] * 8)
    tips[:, :, 2] += bend_m * np.sin(np.linspace(0, np.pi, 8))[:, None]
    assert hinge_motion(tips, (0, 7)) is None


def test_a_loose_object_moves_with_the_palm_while_held():
    motion = np.stack([turn(np.array([0, 0, 1.0]), np.zeros(3), a) for a in np.linspace(0, 1, 6)])
    motion[:, :3, 3] += np.linspace(0, 1, 6)[:, None] * [0.1, 0.2, 0.3]
    palm = np.stack([transform(m, np.eye(3) * 0.1 + 0.2) for m in motion])
    sliding, upright, rigid = couplings(palm, palm_motion(palm, 1), np.array([0, 0, 1.0]), (1, 4))
    relative = motion[4] @ np.linalg.inv(motion[1])
    for path in (sliding, upright, rigid):
        np.testing.assert_array_equal(path[0], path[1])
        np.testing.assert_array_equal(path[5], path[4])
        np.testing.assert_allclose(
            transform(path[4], palm[1].mean(axis=0)[None])[0], palm[4].mean(axis=0)
        )
    np.testing.assert_allclose(rigid[4], relative, atol=1e-9)
    np.testing.assert_allclose(upright[4], relative, atol=1e-9)
    np.testing.assert_array_equal(sliding[4][:3, :3], np.eye(3))


def fingers(opening_cm):
    """Return a thumb at the origin and two fingertips at the given distances, moving together."""
    tips = np.zeros((len(opening_cm), 3, 3))
    tips[:, 1:, 0] = np.array(opening_cm)[:, None] / 100
    return tips + np.linspace(0, 1, len(opening_cm))[:, None, None]


def turn(axis, point, angle):
    """Return the rotation about an axis through a point, by SciPy."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
    motion[:3, 3] = point - motion[:3, :3] @ point
    return motion


@pytest.mark.parametrize(
    ("low_cm", "high_cm", "travel_cm", "firm"),
    [
        ([0.2, -1, -1], [4.8, 1, 1], 10, True),
        ([-0.8, -1, -1], [5.8, 1, 1], 10, True),
        ([0.2, -1, -1], [4.8, 1, 1], 1, False),
        ([2, -2, -2], [8, 2, 2], 10, False),
        ([0.2, 0.4, -1], [4.8, 4, 1], 10, False),
        ([2, -0.2, -0.2], [2.5, 0.2, 0.2], 10, False),
    ],
    ids=[
        "both sides touched",
        "soft fingertips",
        "not carried away",
        "a finger would be inside",
        "closed next to it",
        "not closed on it",
    ],
)
def test_a_grip_is_firm_if_both_sides_are_touched_and_it_leaves(low_cm, high_cm, travel_cm, firm):
    low, high = np.array(low_cm) / 100, np.array(high_cm) / 100
    faces = np.concatenate([np.c_[np.eye(3), -high], np.c_[-np.eye(3), low]])
    tips = np.zeros((6, 3, 3))
    tips[:, 1:, 0] = 0.05
    tips[:, :, 2] = np.linspace(0, travel_cm / 100, 6)[:, None]
    assert is_firm(faces, tips, (0, 5)) == firm


def test_a_noisy_opening_is_no_evidence_of_a_hold():
    tips = np.zeros((60, 3, 3))
    tips[20:40, 1:, 0] = 0.04
    tips[:20, 1:, 0] = tips[40:, 1:, 0] = 0.09
    assert find_holds(tips, TOLERANCE_M) == ([(20, 39)], True)
    tips[:, 1:, 0] += np.random.default_rng(0).normal(0, 0.005, (60, 1))
    holds, sure = find_holds(tips, TOLERANCE_M)
    assert not sure
    assert MAX_ENDS * (MAX_ENDS - 1) / 2 - MAX_ENDS <= len(holds) <= MAX_ENDS**2 / 2
    assert {0, 59} <= {frame for hold in holds for frame in hold}


def test_a_hand_rests_where_it_enters_and_leaves_and_is_interpolated_in_between():
    joints = np.full((8, 21, 3), np.nan)
    for frame in (2, 3, 5):
        joints[frame] = np.random.default_rng(1).normal(0, 0.05, (21, 3)) + frame
    complete = complete_hand(joints, seen_frames(joints))
    step = (complete - complete[2]).mean(axis=(1, 2))
    np.testing.assert_allclose(step, [0, 0, 0, 1, 2, 3, 3, 3], atol=1e-9)
    eyes = np.zeros((8, 3))
    grip = Grip.of(joints, "human", eyes, tolerance_m=TOLERANCE_M, radius_m=0.01)
    assert grip.holds == [(2, 4), (2, 5), (3, 5)]
