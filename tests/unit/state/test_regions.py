"""Two halves of an image of one millimeter a pixel: one region, or two?"""

import numpy as np
import pytest

from egosim_jax.state.regions import RegionConfig, find_regions

HEIGHT, WIDTH, HALF = 40, 60, 30
COLUMN = np.arange(WIDTH)
FLAT = np.zeros(WIDTH)
VALLEY = 0.001 * (HALF - np.abs(COLUMN - HALF + 0.5))


def regions(depth_m=FLAT, color=(0, 0, 0), *, columns=None, footprint_m=0.001):
    """Regions when the right half, or other columns, have another color."""
    row, column = np.mgrid[:HEIGHT, :WIDTH] * 0.001
    points = np.stack([column, row, np.broadcast_to(1 + depth_m, row.shape)], axis=-1)
    lab = np.full((HEIGHT, WIDTH, 3), 50, np.float32)
    lab[:, COLUMN >= HALF if columns is None else columns] += color
    candidates = np.ones((HEIGHT, WIDTH), bool)
    footprint = np.full((HEIGHT, WIDTH), footprint_m)
    found = find_regions(points, lab, candidates, footprint, RegionConfig())
    assert found.min() == 1
    return found


def count(*args, **options):
    return len(np.unique(regions(*args, **options)))


@pytest.mark.parametrize(
    ("slope", "difference", "expected"),
    [
        (0, 9, 1),  # a label
        (1, 0, 1),
        (1, 7.9, 1),
        (1, 8.1, 2),
        (0.122, 9, 1),
        (0.130, 9, 2),
        (-1, 9, 1),  # a ridge: two sides of a box
    ],
)
def test_a_valley_between_two_colors_parts_two_objects(slope, difference, expected):
    assert count(slope * VALLEY, (0, 0, difference)) == expected
    found = regions(slope * VALLEY, (0, 0, difference))
    assert (found[:, :HALF] == found[0, 0]).all()
    assert (found[:, HALF:] == found[0, -1]).all()


def test_lightness_counts_half_for_borders_and_a_fifth_for_pieces():
    assert count(VALLEY, (15.8, 0, 0)) == 1
    apart = 0.008 * (COLUMN >= HALF)
    assert count(apart, (39, 0, 0)) == 1
    assert count(apart, (41, 0, 0)) == 2


@pytest.mark.parametrize(
    ("step_m", "footprint_m", "expected"),
    [(0.0055, 0.001, 1), (0.0065, 0.001, 2), (0.0065, 0.002, 1), (0.0085, 0.002, 2)],
)
def test_a_jump_of_the_depth_parts_two_colors(step_m, footprint_m, expected):
    depth_m = step_m * (COLUMN >= HALF)
    assert count(depth_m, (0, 9, 0), footprint_m=footprint_m) == expected


@pytest.mark.parametrize(
    ("width", "gap_m", "expected"),
    [(30, 0.0088, 1), (30, 0.0095, 2), (14, 0.0095, 2), (10, 0.0118, 1), (10, 0.0122, 2)],
)
def test_separate_pieces_of_a_color_join_if_they_are_close(width, gap_m, expected):
    depth_m = np.sqrt(gap_m**2 - 0.001**2) * (WIDTH - width <= COLUMN)
    assert count(depth_m) == expected


@pytest.mark.parametrize(
    ("width", "gap_m", "expected"), [(2, 0.059, 1), (2, 0.061, 2), (3, 0.059, 2)]
)
def test_a_sliver_joins_the_object_next_to_it_whatever_its_color(width, gap_m, expected):
    sliver = WIDTH - width <= COLUMN
    depth_m = np.sqrt(gap_m**2 - 0.001**2) * sliver
    assert count(depth_m, (0, 0, 20), columns=sliver) == expected
