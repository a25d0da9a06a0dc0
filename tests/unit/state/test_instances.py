"""Objects of RGB-D images of boxes on a table."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.state.depth import state_from_depth
from egosim_jax.state.instances import ObjectSearch, find_objects, object_sizes
from egosim_jax.types import InputError
from tests.boxes import GREEN, RED, Box, cameras, cast

VIEW = cameras(1)
BLUE = (50, 80, 180)


def search(boxes, view=VIEW, change=lambda depth: depth, **options):
    image, depth, ids = cast(boxes, view)
    thresholds = ObjectSearch(**options)
    return find_objects(image, change(depth), view.intrinsics_px, thresholds), ids


def overlaps(found, ids):
    """IoU of each object's pixels with those found, by id; and the number of found objects."""
    unions = {}
    for number in np.unique(ids[ids > 0]).tolist():
        own = ids == number
        best = np.bincount(found[own & (found > 0)], minlength=2).argmax()
        unions[number] = (own & (found == best)).sum() / (own | (found == best)).sum()
    return unions, int(found.max())


NEXT = Box((-0.01, 0.09, 0), (0.05, 0.05, 0.04), BLUE, 2)
STACKED = Box((-0.05, 0.09, 0.07), (0.03, 0.03, 0.03), BLUE, 2)
CUT = replace(RED, corner_m=(0.05, -0.09, 0), color=BLUE, number=2)
LARGE = Box((-0.15, 0.05, 0), (0.22, 0.2, 0.1), BLUE, 1)
THIN = Box((0.05, 0.05, 0), (0.1, 0.012, 0.012), BLUE, 2)


@pytest.mark.parametrize(
    "boxes",
    [
        pytest.param([RED, GREEN], id="apart"),
        pytest.param([RED, NEXT], id="touching"),
        pytest.param([RED, STACKED], id="stacked"),
        pytest.param([RED, CUT], id="cut by the border"),
        pytest.param([LARGE], id="larger than a hand"),
        pytest.param([RED, THIN], id="thin"),
    ],
)
def test_what_stands_on_the_table_is_found(boxes):
    unions, count = overlaps(*search(boxes))
    assert count == len(boxes)
    assert min(unions.values()) > 0.75, unions


def test_a_label_belongs_to_its_box_and_a_crumb_is_no_object():
    label = replace(RED, corner_m=(-0.05, 0.0799, 0.02), size_m=(0.03, 0.01, 0.03), color=BLUE)
    crumb = Box((0.05, 0.05, 0), (0.006, 0.006, 0.004), (20, 20, 20), 0)
    unions, count = overlaps(*search([RED, label, crumb]))
    assert count == 1
    assert unions[1] > 0.9


def test_a_table_without_objects_has_none():
    assert not search([])[0].any()


@pytest.mark.parametrize(
    ("foot_m", "others", "count"), [(0.05, [], 1), (0.12, [], 0), (0.12, [RED], 1)]
)
def test_an_object_stands_on_the_table_or_shows_its_upper_half_alone(foot_m, others, count):
    found, _ = search([Box((0.05, 0, foot_m), (0.05, 0.05, 0.06), BLUE, 2), *others])
    assert found.max() == count


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda depth: np.round(depth, 3), id="quantized to millimeters"),
        pytest.param(lambda depth: depth * (1 + 0.03 * np.linspace(-1, 1, 160) ** 2), id="bent"),
        pytest.param(
            lambda depth: depth * (1 + np.random.default_rng(0).normal(0, 0.002, depth.shape)),
            id="noise",
        ),
    ],
)
def test_objects_are_found_in_depth_of_sensors_and_networks(change):
    unions, count = overlaps(*search([RED, GREEN], change=change))
    assert count == 2
    assert min(unions.values()) > 0.7, unions


def test_a_subsampled_image_has_the_same_objects():
    unions, count = overlaps(
        *search([RED, GREEN], view=cameras(1, height=192, width=320), max_width=160)
    )
    assert count == 2
    assert min(unions.values()) > 0.8, unions


@pytest.mark.parametrize("max_width", [160, 107])
def test_the_edge_of_an_object_belongs_to_it_in_a_subsampled_image(max_width):
    view = cameras(1, height=192, width=320)
    box = replace(GREEN, size_m=(0.06, 0.06, 0.15))  # far before the table behind its edge
    _, depth, ids = cast([box], view)
    labels, _ = search([box], view=view, max_width=max_width)
    jumps = np.diff(depth, axis=0) < -0.05 * depth[1:]
    top = np.argwhere(jumps & (np.diff((ids > 0).astype(int), axis=0) == 1)) + [1, 0]
    assert len(top) > 20
    assert (labels[tuple(top.T)] > 0).mean() > 0.9


def test_sizes_are_of_the_visible_points():
    image, depth, ids = cast([GREEN], VIEW)
    state = state_from_depth(image, depth, VIEW.intrinsics_px, np.eye(4), object_ids=ids)
    (size,) = object_sizes(state).values()
    np.testing.assert_allclose(size, [0.06, 0.06, 0.1], atol=0.012)


def test_arrays_that_do_not_fit_are_refused():
    image, depth, _ = cast([], VIEW)
    with pytest.raises(InputError, match="must have the same size"):
        find_objects(image[:-1], depth, VIEW.intrinsics_px)
    with pytest.raises(InputError, match="Convert depth_m to meters"):
        find_objects(image, 1000 * depth, VIEW.intrinsics_px)
