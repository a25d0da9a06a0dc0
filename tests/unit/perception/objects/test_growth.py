"""Growth of objects without an id, on boxes and sheets that a formula gives."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import look_at
from egosim_jax.perception.objects.growth import NEW, Growth, clusters_without_id
from tests.scenes import state_of

RED, BLUE, WOOD = (200, 30, 30), (30, 40, 190), (150, 140, 120)
STEP_M = 0.004
POSE = look_at(np.array([-0.3, -0.5, 0.6]), np.zeros(3), up=np.array([0, 0, 1.0]))


def box(low, high, color, *, sides=3):
    """Return the points of a box's top, front and left side, or of the first of them."""
    x, y, z = (np.arange(a, b + 1e-9, STEP_M) for a, b in zip(low, high, strict=True))
    faces = [
        np.stack(np.meshgrid(x, y, high[2:]), axis=-1),
        np.stack(np.meshgrid(x, low[1:2], z), axis=-1),
        np.stack(np.meshgrid(low[:1], y, z), axis=-1),
    ]
    return np.concatenate([face.reshape(-1, 3) for face in faces[:sides]]), color


def scene(*clusters):
    """Return a state without ids: clusters on a wooden table."""
    side = np.arange(-0.3, 0.3, STEP_M)
    table = np.stack(np.meshgrid(side, side, [0.0]), axis=-1).reshape(-1, 3)
    pieces = [(table, WOOD), *clusters]
    points = np.concatenate([points for points, _ in pieces])
    colors = np.concatenate([np.full((len(p), 3), color) for p, color in pieces])
    return state_of(points, colors=colors, provenance={"world": "tabletop"})


def closed_on(thumb, fingers):
    """Return the places of thumb and fingers when a hand closes once."""
    return np.array([[thumb, fingers]], float)


def grown(state, grip, config=None):
    """Return the growths of the only cluster in a grip, as numbers of points by color."""
    clusters, note = clusters_without_id(grip, POSE, state, config or Growth())
    assert note == ""
    (growths,) = clusters
    assert {model.number for model in growths} == {NEW}
    return [
        {color: int((model.colors == color).all(axis=1).sum()) for color in (RED, BLUE, WOOD)}
        for model in growths
    ]


CUBE = box((-0.02, -0.02, 0.001), (0.02, 0.02, 0.041), RED)
GRIP = closed_on((-0.025, 0, 0.03), (0.025, 0, 0.03))


def test_a_box_on_a_table_is_grown_whole_and_without_the_table():
    first = grown(scene(CUBE), GRIP)[0]
    assert first[RED] > 0.9 * len(CUBE[0])
    assert first[WOOD] == 0


def test_the_lowest_points_of_an_object_are_its_own():
    (first, *_) = grown(scene(CUBE), GRIP)
    assert first[RED] >= 0.97 * len(CUBE[0])


@pytest.mark.parametrize(
    "other",
    [
        box((0.024, -0.02, 0), (0.06, 0.02, 0.04), BLUE, sides=2),
        box((-0.06, -0.06, 0), (0.06, -0.02, 0.02), BLUE),
    ],
    ids=["flush", "lower"],
)
def test_an_object_that_touches_another_has_its_own_growth(other):
    growths = grown(scene(CUBE, other), GRIP)
    assert growths[0][BLUE] > 0
    assert any(g[BLUE] == 0 and g[RED] > 0.9 * len(CUBE[0]) for g in growths)


def test_a_stacked_object_of_the_same_color_ends_at_the_concave_edge():
    points, _ = box((-0.06, -0.06, 0), (0.06, 0.06, 0.04), RED)
    hidden = (np.abs(points[:, :2]) < 0.02).all(axis=1)
    below = points[~hidden], RED
    above = box((-0.02, -0.02, 0.04), (0.02, 0.02, 0.08), RED)
    grip = closed_on((-0.025, 0, 0.07), (0.025, 0, 0.07))
    sizes = [growth[RED] for growth in grown(scene(below, above), grip)]
    assert sizes[0] > 0.9 * len(below[0])
    assert any(0.7 * len(above[0]) < size < 1.2 * len(above[0]) for size in sizes), sizes


def test_colors_say_which_points_of_a_concave_edge_are_an_objects():
    points, _ = box((-0.06, -0.06, 0), (0.06, 0.06, 0.04), BLUE)
    below = points[(np.abs(points[:, :2]) >= 0.02).any(axis=1)], BLUE
    above = box((-0.02, -0.02, 0.04), (0.02, 0.02, 0.08), RED)
    growths = grown(scene(below, above), closed_on((-0.025, 0, 0.07), (0.025, 0, 0.07)))
    assert {RED: len(above[0]), BLUE: 0, WOOD: 0} in growths


@pytest.mark.parametrize(
    ("clusters", "note"),
    [
        ([], "closed on nothing"),
        ([box((-0.28, -0.02, 0), (0.28, 0.02, 0.04), RED)], "larger than 0.35 m"),
    ],
    ids=["nothing", "too large"],
)
def test_why_nothing_is_grown_is_said(clusters, note):
    state = scene(*clusters)
    lifted = GRIP + [0, 0, 0.0 if clusters else 0.1]
    found, said = clusters_without_id(lifted, POSE, state, Growth())
    assert found == []
    assert note in said


def test_a_sheet_that_looks_like_the_table_is_not_found():
    sheet = box((-0.05, -0.05, 0), (0.05, 0.05, 0.001), WOOD)
    low = GRIP - [0, 0, 0.028]
    found, said = clusters_without_id(low, POSE, scene(sheet), Growth())
    assert found == []
    assert said == "closed on something that looks like its support"


def test_points_with_an_id_are_not_grown():
    state = scene(CUBE)
    red = (state.colors == RED).all(axis=1)
    known = replace(state, object_ids=red.astype(np.int32))
    assert clusters_without_id(GRIP, POSE, known, Growth())[0] == []
