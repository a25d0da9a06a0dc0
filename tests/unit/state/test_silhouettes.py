"""Colors of the background at silhouettes, in the states that begin a world."""

import cv2
import numpy as np
import pytest

from egosim_jax.geometry import pixel_rays
from egosim_jax.state.depth import state_from_depth
from egosim_jax.state.silhouettes import unmix_colors
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import raycast, start_of_sequence

MATRIX = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
TABLE, BALL = np.array([150, 140, 120]), np.array([20, 60, 200])


def photo():
    """A ball over a table, in pixels that mix at its silhouette; image, depth and ids."""
    row, column = np.mgrid[:192, :256]
    fine = np.where(((row - 90) ** 2 + (column - 120) ** 2 < 42**2)[..., None], BALL, TABLE)
    image = cv2.resize(fine.astype(np.uint8), (64, 48), interpolation=cv2.INTER_AREA)
    ids = (np.abs(image.astype(int) - TABLE).sum(axis=-1) > 130).astype(np.int32)
    return image, np.where(ids, 0.5, 0.6), ids


@pytest.mark.parametrize("density", [1, 2])
def test_no_color_of_an_object_stays_on_the_table(density):
    image, depth, ids = photo()
    assert np.abs(image[ids == 0].astype(int) - TABLE).max() > 40
    state = state_from_depth(
        image, depth, MATRIX, np.eye(4), object_ids=ids, points_per_pixel=density
    )
    table = state.colors[state.object_ids == 0]
    assert np.abs(table.astype(int) - TABLE).max() <= 10  # the photo's resampling rings
    assert np.abs(state.colors[state.object_ids == 1].astype(int) - BALL).min() == 0


def test_a_color_that_is_no_mix_stays():
    image, depth, ids = photo()
    mixed = (ids == 0) & (image != TABLE).any(axis=-1)
    image[mixed] = [20, 200, 20]  # a green rim
    points = (pixel_rays(MATRIX, height=48, width=64) * depth[..., None]).reshape(-1, 3)
    colors = image.reshape(-1, 3)
    kept = unmix_colors(points, colors, ids.ravel(), np.eye(4), MATRIX)
    np.testing.assert_array_equal(kept, colors)


def test_colors_stay_where_too_few_are_clean():
    points = np.array([[0.01 * x, 0, 1] for x in (0, 1, 5, 6, 7, 8)])
    colors = np.array([[0, 0, 0], *[[40, 40, 40]] * 5], np.uint8)
    ids, matrix = np.array([1, 0, 0, 0, 0, 0]), np.diag([100.0, 100, 1])
    np.testing.assert_array_equal(unmix_colors(points, colors, ids, np.eye(4), matrix), colors)


def test_the_tabletop_world_begins_without_mixed_colors(monkeypatch):
    spec = VideoSpec(frames=1, height=48, width=80, fps=8)
    state = start_of_sequence(701, spec=spec)[3]
    monkeypatch.setattr(raycast, "RAYS", 1)  # a pixel's center alone mixes nothing
    clean = start_of_sequence(701, spec=spec)[3]
    background = state.object_ids == 0
    off = np.abs(state.colors[background].astype(float) - clean.colors[background]).mean(axis=1)
    assert (off > 40).mean() < 0.001
