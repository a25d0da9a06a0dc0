"""Point clouds as other programs write them: names of colors, splats, and refusals."""

import numpy as np
import pytest

from egosim_jax.state.ply import write_points
from egosim_jax.state.snapshot import read_ply
from egosim_jax.types import InputError

PLACES = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8]], np.float32)
LEVELS = np.array([[10, 20, 30], [40, 50, 60], [255, 0, 128]], np.uint8)


def write(path, names, colors, places=PLACES, **more):
    columns = dict(zip("xyz", places.T, strict=True)) | dict(zip(names, colors.T, strict=True))
    write_points(path, {n: np.ascontiguousarray(c) for n, c in (columns | more).items()})
    return path


@pytest.mark.parametrize(
    "names",
    [
        ("red", "green", "blue"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        ("r", "g", "b"),
    ],
)
@pytest.mark.parametrize("kind", ["uint8", "float32", "float64"])
def test_names_and_kinds_of_colors(tmp_path, names, kind):
    colors = LEVELS if kind == "uint8" else (LEVELS / 255).astype(kind)
    state = read_ply(write(tmp_path / "a.ply", names, colors))
    np.testing.assert_array_equal(state.colors, LEVELS)
    np.testing.assert_array_equal(state.points_m, PLACES)


def test_opaque_splats_are_points_of_their_base_color(tmp_path):
    harmonics = ((LEVELS / 255 - 0.5) / 0.28209479).astype(np.float32)
    opacity = np.array([4.0, -4.0, 0.5], np.float32)
    path = write(tmp_path / "a.ply", ("f_dc_0", "f_dc_1", "f_dc_2"), harmonics, opacity=opacity)
    state = read_ply(path)
    np.testing.assert_array_equal(state.points_m, PLACES[[0, 2]])
    np.testing.assert_array_equal(state.colors, LEVELS[[0, 2]])


@pytest.mark.parametrize(
    ("colors", "places", "message"),
    [
        (LEVELS.astype(np.int32), PLACES, "Save the PLY with uchar"),
        (LEVELS.astype(np.uint16) * 257, PLACES, "Save the PLY with uchar"),
        (LEVELS.astype(np.float32), PLACES, "Save the PLY with uchar"),
        (LEVELS, np.where(PLACES == 4, np.nan, PLACES), "1 of 3 points.*remove_non_finite_points"),
        (LEVELS, np.where(PLACES > 4, np.inf, PLACES), "2 of 3 points.*remove_non_finite_points"),
    ],
)
def test_what_is_refused_names_a_fix(tmp_path, colors, places, message):
    path = write(tmp_path / "a.ply", ("red", "green", "blue"), colors, places.astype(np.float32))
    with pytest.raises(InputError, match=message):
        read_ply(path)


def test_points_without_colors_are_refused_with_a_fix(tmp_path):
    path = write(tmp_path / "a.ply", ("nx", "ny", "nz"), PLACES)
    with pytest.raises(InputError, match="Save the points with colors"):
        read_ply(path)
