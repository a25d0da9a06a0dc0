"""Palms, regions and candidates of hands, with networks that detect painted hands."""

import numpy as np
import pytest

from egosim_jax.perception.video.hands.detect import (
    find_candidates,
    find_other_side,
    relative_distance,
    right_by_bend,
    right_by_forearm,
)
from egosim_jax.perception.video.hands.palms import (
    Tile,
    cut_tile,
    decode_palms,
    make_anchors,
    make_tiles,
    merge_overlapping,
)
from egosim_jax.perception.video.hands.regions import (
    Regions,
    crop_region,
    joints_in_image,
    regions_of_joints,
    regions_of_palms,
    unrotate,
)
from tests.hands import PaintedHands, hand_px, paint


def test_anchors_are_the_centers_of_two_grids():
    anchors = make_anchors()
    assert anchors.shape == (2016, 2)
    np.testing.assert_allclose(anchors[:3] * 24, [[0.5, 0.5], [0.5, 0.5], [1.5, 0.5]])
    np.testing.assert_allclose(anchors[1152:1159] * 12, [[0.5, 0.5]] * 6 + [[1.5, 0.5]])
    np.testing.assert_allclose(anchors.mean(0), 0.5, atol=1e-6)


def test_tiles_hold_all_of_a_frame_and_squares_along_it():
    assert make_tiles(480, 832) == [Tile(0, -176, 832), Tile(0, 0, 480), Tile(352, 0, 480)]
    assert make_tiles(832, 480)[1:] == [Tile(0, 0, 480), Tile(0, 352, 480)]
    assert make_tiles(500, 512) == [Tile(0, -6, 512)]
    assert len(make_tiles(400, 1600)) == 5


def test_a_tile_is_padded_with_black():
    image = cut_tile(np.full((96, 192, 3), 200, np.uint8), Tile(0, -48, 192))
    assert (image[:48] == 0).all()
    assert (image[144:] == 0).all()
    assert (image[48:144] == 200).all()


def test_a_palm_is_decoded_to_pixels_of_the_frame():
    boxes, logits = np.zeros((2, 2016, 18), np.float32), np.full((2, 2016), -50, np.float32)
    logits[1, 0] = 3
    boxes[1, 0] = [4, 8, 24, 12, *range(14)]
    tiles = [Tile(0, 0, 384), Tile(100, 20, 384)]
    palms = decode_palms(boxes, logits, tiles, min_score=0.5)
    corner = np.array([100, 20]) + 8 - 0.5
    np.testing.assert_allclose(palms.boxes_px, [[*(corner + [8, 16]), 48, 24]], rtol=1e-6)
    np.testing.assert_allclose(palms.keypoints_px[0, 3], corner + [12, 14], rtol=1e-6)
    np.testing.assert_allclose(palms.score, 1 / (1 + np.exp(-3)))


def test_overlapping_palms_are_merged_by_their_scores():
    values = np.zeros((3, 9, 2))
    values[:, 0] = [[10, 10], [14, 10], [90, 90]]
    values[:, 1] = 20
    palms = merge_overlapping(values, np.array([0.9, 0.3, 0.6]))
    np.testing.assert_allclose(palms.score, [0.9, 0.6])
    np.testing.assert_allclose(palms.boxes_px[0], [11, 10, 20, 20])
    np.testing.assert_allclose(palms.boxes_px[1], [90, 90, 20, 20])


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0, np.pi])
def test_the_region_of_a_hand_turns_with_it_and_grows_with_it(angle):
    upright = regions_of_joints(hand_px(center=(0, 0))[None])
    turned = regions_of_joints(2 * hand_px(center=(0, 0), angle=angle)[None] + [300, 200])
    np.testing.assert_allclose(upright.angle, 0, atol=1e-6)
    np.testing.assert_allclose(np.exp(1j * turned.angle), np.exp(1j * angle), atol=1e-6)
    np.testing.assert_allclose(turned.size_px, 2 * upright.size_px, rtol=1e-6)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    expected = 2 * rotation @ upright.center_px[0] + [300, 200]
    np.testing.assert_allclose(turned.center_px[0], expected, atol=1e-6)


def test_the_region_of_a_palm_is_shifted_to_the_fingers():
    keypoints = np.zeros((1, 7, 2))
    keypoints[:, 0], keypoints[:, 2] = [100, 120], [100, 80]
    regions = regions_of_palms(np.array([[100.0, 100, 40, 30]]), keypoints)
    np.testing.assert_allclose(regions.center_px, [[100, 85]])
    np.testing.assert_allclose(regions.size_px, [104])
    np.testing.assert_allclose(regions.angle, [0])


def test_a_point_of_the_frame_is_where_its_crop_has_it():
    frame = np.zeros((200, 300, 3), np.uint8)
    frame[70:73, 180:183] = 255
    regions = Regions(
        center_px=np.array([[170.0, 90.0]]), size_px=np.array([112.0]), angle=np.array([0.6])
    )
    crop = crop_region(frame, regions, 0)[..., 0].astype(float)
    row, column = np.mgrid[:224, :224]
    inside = np.array([(crop * column).sum(), (crop * row).sum()]) / crop.sum() + 0.5
    joints = np.tile(inside, (1, 21, 1))
    np.testing.assert_allclose(joints_in_image(regions, joints)[0, 0], [181, 71], atol=0.1)


def test_meters_are_turned_with_the_region_and_keep_their_depth():
    regions = Regions(center_px=np.zeros((1, 2)), size_px=np.ones(1), angle=np.array([np.pi / 2]))
    joints = np.tile([0.0, -0.1, 0.03], (1, 21, 1))  # up in the crop is right in the image
    np.testing.assert_allclose(unrotate(regions, joints)[0, 0], [0.1, 0, 0.03], atol=1e-9)


def search(frames, networks, **options):
    settings = {"min_palm": 0.5, "min_presence": 0.5, "same_hand": 0.4, **options}
    return find_candidates(frames, networks, **settings)


def test_a_hand_is_found_where_it_was_painted():
    hands = [hand_px(center=(150 + 4 * i, 120), angle=0.3) for i in range(4)]
    found = search(paint([[hand] for hand in hands]), PaintedHands())
    assert found.frame.tolist() == [0, 1, 2, 3]
    assert relative_distance(found.joints_px, np.array(hands)).max() < 0.05
    assert (found.palm > 0.9).all()


def test_a_hand_is_followed_both_ways_from_the_only_frame_with_its_palm():
    hands = [hand_px(center=(150 + 4 * i, 120)) for i in range(5)]
    frames = paint([[hand] for hand in hands], hidden={0, 1, 3, 4})
    found = search(frames, PaintedHands())
    assert found.frame.tolist() == [0, 1, 2, 3, 4]
    assert relative_distance(found.joints_px, np.array(hands)).max() < 0.05
    np.testing.assert_allclose(found.palm[[0, 1, 3, 4]], 0)


def test_only_wanted_frames_are_searched():
    frames = paint([[hand_px(center=(150, 120))]] * 4)
    found = search(frames, PaintedHands(), wanted=np.array([False, True, True, False]))
    assert found.frame.tolist() == [1, 2]


def test_a_video_without_hands_has_no_candidates():
    assert len(search(paint([[], []]), PaintedHands())) == 0


@pytest.mark.parametrize(("angle", "right"), [(-0.6, True), (0.6, False)])
def test_a_forearm_enters_on_the_side_of_its_hand(angle, right):
    hands = np.stack([hand_px(center=(160, 80), angle=angle), hand_px(center=(160, 80), angle=3)])
    sides = right_by_forearm(hands, 240, 320)
    assert (sides[0] > 0.5) == right
    assert abs(sides[0] - 0.5) > 0.3
    assert sides[1] == 0.5  # it enters from above


def test_fingers_bend_to_the_other_side_in_a_mirror():
    hand = np.concatenate([hand_px(center=(0, 0)), np.zeros((21, 1))], -1)[None] / 1000
    hand[:, [7, 8, 11, 12, 15, 16, 19, 20], 2] = 0.04
    sides = right_by_bend(np.concatenate([hand, hand * [-1, 1, 1]]))
    np.testing.assert_allclose(sides.sum(), 1)
    assert sides.max() > 0.9
    assert right_by_bend(hand * [1, 1, 0]) == 0.5


def test_a_hand_is_searched_again_for_joints_of_its_side():
    frames = paint([[hand_px(center=(150, 120))]] * 2, right=False)
    hands = search(frames, PaintedHands())
    settings = {"min_presence": 0.5, "same_hand": 0.2}
    again = find_other_side(frames, PaintedHands(), hands, right=False, **settings)
    assert sorted(again.frame) == [0, 1]
    assert relative_distance(again.joints_px, hands.joints_px).max() < 0.1
    assert len(find_other_side(frames, PaintedHands(), hands, right=True, **settings)) == 0
