"""Clean plates of the tabletop world, versus the known image behind the hands."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.perception.video.plate import clean_plate
from egosim_jax.worlds.tabletop.scene import FIRST_HAND
from tests.scenes import pinhole
from tests.unit.perception.posed import make_clip


@pytest.fixture(scope="module")
def clip():
    return make_clip()


@pytest.fixture(scope="module")
def covered(clip):
    """Return a clip with a dark occluder that passes over the hand-free first frame."""
    frames = np.repeat(clip.first.colors[None], 5, axis=0)
    moving = np.zeros(frames.shape[:3], bool)
    for number in range(5):
        moving[number, 20:60, 40 + 30 * number : 80 + 30 * number] = True
    frames[moving] = (20, 10, 5)
    poses = np.repeat(clip.cameras.world_from_camera[:1], 5, axis=0)
    return frames, moving, replace(clip.cameras, world_from_camera=poses)


def test_pixels_behind_an_occluder_come_from_later_frames(clip, covered):
    frames, moving, cameras = covered
    plate = clean_plate(frames, moving, cameras, clip.first.depth_m)
    difference = np.abs(plate.image.astype(int) - clip.first.colors)
    assert plate.method == "none"
    assert plate.seen[moving[0]].all()
    assert difference[moving[0]].mean() < 2
    np.testing.assert_array_equal(plate.image[~plate.seen], frames[0][~plate.seen])


def test_an_object_that_is_carried_away_stays(clip):
    moving = clip.ids >= FIRST_HAND
    target = clip.body_ids[clip.target]
    plate = clean_plate(clip.frames, moving, clip.cameras, clip.first.depth_m)
    body = (clip.first.ids == target) & ~plate.seen & ~moving[0]
    assert body.sum() > 50
    assert (clip.ids[-1][body] != target).any()
    np.testing.assert_array_equal(plate.image[body], clip.frames[0][body])


def test_frames_in_which_the_surroundings_have_moved_are_not_used(clip, covered):
    frames, moving, cameras = covered
    changed = frames.copy()
    changed[1:, 10:75, 20:110] = np.random.default_rng(0).integers(0, 255, (4, 65, 90, 3))
    changed[moving] = (20, 10, 5)
    plate = clean_plate(changed, moving, cameras, clip.first.depth_m)
    assert not plate.seen.any()
    assert plate.method == "patchmatch"


def test_pixels_that_no_frame_shows_are_filled_by_patches(clip, covered):
    frames, moving, cameras = covered
    always = moving | moving[0]
    plate = clean_plate(frames, always, cameras, clip.first.depth_m)
    assert plate.method == "patchmatch"
    assert not plate.seen.any()
    filled = plate.image[moving[0]]
    assert np.abs(filled - np.array([20, 10, 5])).sum(axis=1).min() > 10


@pytest.mark.parametrize("method", ["patchmatch", "telea"])
def test_a_hole_next_to_a_moved_object_is_filled_with_background(method, monkeypatch):
    if method == "telea":
        monkeypatch.setitem(__import__("sys").modules, "patchmatch", None)
    frames = np.full((3, 60, 90, 3), (90, 120, 90), np.uint8)
    frames += np.random.default_rng(0).integers(0, 20, frames.shape, np.uint8)
    moving, moved = np.zeros((2, 3, 60, 90), bool)
    moving[:, 20:40, 40:60] = moved[0, 15:45, 15:40] = moved[1:, 15:45, 35:60] = True
    moving[1:] &= ~moved[1:]  # the object is now in front of the hole
    frames[moved] = (220, 30, 30)
    frames[moving] = (20, 10, 5)
    plate = clean_plate(frames, moving, pinhole(3, 50.0, 60, 90), np.ones((60, 90)), moved=moved)
    hole = moving[0] & ~moved[0]
    assert plate.method == method
    assert not plate.seen.any()
    assert plate.image[hole, 0].max() < 150
    assert (plate.image[15:45, 15:37] == frames[0, 15:45, 15:37]).all()


def test_a_frame_without_hands_is_unchanged(clip, covered):
    frames, moving, cameras = covered
    plate = clean_plate(frames, np.zeros_like(moving), cameras, clip.first.depth_m)
    np.testing.assert_array_equal(plate.image, frames[0])
