"""Silhouettes and positions by color, against known ones."""

import numpy as np
import pytest
from scipy import ndimage

from egosim_jax.evaluation.metrics.region import (
    centroid_errors,
    held_and_released,
    label,
    lost_share,
    open_mask,
    right_share,
    silhouette_iou,
    squared_error,
)
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import make_sequence
from egosim_jax.worlds.tabletop.scene import FIRST_HAND


def discs(*centers, radius=4):
    rows, columns = np.mgrid[:32, :48]
    return np.stack([np.hypot(rows - y, columns - x) <= radius for y, x in centers])


def test_a_pixel_has_the_label_of_the_nearest_color_under_some_light():
    paints = {3: (200, 40, 40), 7: (40, 40, 200)}
    rng = np.random.default_rng(0)
    video, background = rng.integers(0, 256, (2, 1, 8, 8, 3), dtype=np.uint8)
    got = label(video, background, paints)
    assert set(np.unique(got)) == {0, 3, 7}
    for row, column in np.ndindex(8, 8):
        pixel = video[0, row, column].astype(float)
        distances = {}
        for number, color in {0: background[0, row, column], **paints}.items():
            color = np.array(color, float)
            shade = min(max(pixel @ color / (color @ color), 0.45), 1.15)
            distances[number] = np.linalg.norm(pixel - shade * color)
        assert got[0, row, column] == min(distances, key=distances.get)


def test_iou_of_silhouettes_over_the_frames_that_have_one():
    truth = discs((10, 10), (10, 10))
    found = np.stack([truth[0], discs((40, 90))[0]])
    assert silhouette_iou(found, truth) == pytest.approx(0.5)
    truth[1] = False
    assert silhouette_iou(found, truth) == 1
    assert np.isnan(silhouette_iou(found, np.zeros_like(truth)))


@pytest.mark.parametrize("density", [0.4, 0.7, 0.95])
def test_opening_of_random_masks_is_that_of_scipy(density):
    masks = np.random.default_rng(0).random((20, 17, 23)) < density
    square = np.ones((3, 3), bool)
    eroded = [ndimage.binary_erosion(mask, square, border_value=True) for mask in masks]
    expected = [ndimage.binary_dilation(mask, square) for mask in eroded]
    np.testing.assert_array_equal(open_mask(masks), expected)


def test_the_distance_of_centroids_leaves_stray_pixels_out():
    truth = discs((10, 10), (10, 10), (10, 10), (40, 90))
    found = discs((13, 14), (10, 10), (40, 90), (10, 10))
    found[0] |= discs((28, 44), radius=1)[0]
    np.testing.assert_allclose(centroid_errors(found, truth), [5, 0, 48])


def test_an_object_is_lost_in_the_frames_that_show_it_where_nothing_was_found():
    truth = discs((10, 10), (10, 10), (10, 10), (40, 90))
    found = discs((13, 14), (40, 90), (10, 10), (10, 10))
    assert lost_share(found, truth) == pytest.approx(1 / 3)
    assert np.isnan(lost_share(found, np.zeros_like(truth)))


@pytest.mark.parametrize(("kind", "least"), [("human", 0.85), ("robot", 0.75)])
def test_the_metrics_find_hands_and_objects_in_the_ground_truth(kind, least):
    """A gray gripper over a slate table is found less well."""
    spec = VideoSpec(frames=5, height=96, width=160)
    for seed in (100, 101, 102):
        clip, bare = (
            next(make_sequence(seed, spec=spec, kind=kind, bare=bare)) for bare in (False, True)
        )
        target = clip.body_ids[clip.target]
        movers = {n: c for n, c in clip.paints.items() if n == target or n >= FIRST_HAND}
        seen = label(clip.frames, bare.frames, movers)
        assert silhouette_iou(open_mask(seen >= FIRST_HAND), clip.ids >= FIRST_HAND) > least
        assert centroid_errors(seen == target, clip.ids == target).max() < 2


def test_pixels_within_30_levels_are_right_and_all_count_in_the_error():
    target = np.full((2, 4, 4, 3), 100, np.uint8)
    video, region = target.copy(), np.zeros((2, 4, 4), bool)
    region[0, 0] = True
    video[0, 0] = [[130, 100, 100], [131, 100, 100], [100, 69, 100], [100, 100, 100]]
    video[1] = 0  # outside of the region
    assert right_share(video, target, region) == 0.5
    assert squared_error(video, target, region) == pytest.approx((30**2 + 2 * 31**2) / 12)
    assert np.isnan(right_share(video, target, region & False))


def test_an_object_moves_in_some_frames_and_then_rests():
    path = np.repeat(np.eye(4)[None], 6, axis=0)
    path[2:, 0, 3], path[4:, 1, 3] = 0.05, 0.002
    moving, after = held_and_released(path)
    assert moving.tolist() == [False, False, True, False, True, False]
    assert after.tolist() == [False, False, False, False, False, True]
