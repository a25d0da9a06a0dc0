"""Rigid motions form a group, and cameras agree with their rays."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from egosim_jax.geometry import invert, look_at, pixel_rays, project, transform, umeyama

NEAR = 1e-9
"""Tolerance in meters: float64, with coordinates of some meters."""
seeds = st.integers(0, 2**32 - 1)


@st.composite
def motions(draw):
    rng = np.random.default_rng(draw(seeds))
    motion = np.eye(4)
    motion[:3, :3] = Rotation.random(rng=rng).as_matrix()
    motion[:3, 3] = rng.normal(size=3)
    return motion


@st.composite
def clouds(draw):
    return np.random.default_rng(draw(seeds)).normal(size=(draw(st.integers(4, 9)), 3))


@given(motions(), motions(), motions(), clouds())
def test_motions_form_a_group(a, b, c, points):
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=NEAR)
    np.testing.assert_allclose(invert(a) @ a, np.eye(4), atol=NEAR)
    np.testing.assert_allclose(invert(a @ b), invert(b) @ invert(a), atol=NEAR)
    np.testing.assert_allclose(invert(invert(a)), a, atol=NEAR)
    np.testing.assert_allclose(
        transform(a @ b, points), transform(a, transform(b, points)), atol=NEAR
    )


@given(motions(), clouds())
def test_motions_keep_distances(motion, points):
    def distances(at):
        return np.linalg.norm(at[:, None] - at, axis=-1)

    np.testing.assert_allclose(distances(transform(motion, points)), distances(points), atol=NEAR)


@given(motions(), clouds(), st.floats(0.1, 10))
def test_the_motion_between_two_clouds_is_recovered(motion, points, scale):
    similarity = motion @ np.diag([scale, scale, scale, 1])
    found = umeyama(points, transform(similarity, points), scaled=True)
    np.testing.assert_allclose(found, similarity, atol=1e-7)


@given(st.integers(1, 6), st.integers(1, 6), seeds)
def test_a_pixels_ray_at_any_depth_is_seen_in_that_pixel(height, width, seed):
    rng = np.random.default_rng(seed)
    focal = rng.uniform(5, 50, 2)
    intrinsics = np.array([[focal[0], 0, width / 2], [0, focal[1], height / 2], [0, 0, 1]])
    rays = pixel_rays(intrinsics, height=height, width=width)
    points = rays * rng.uniform(0.1, 5, (height, width, 1))
    u, v = project(intrinsics, points)
    rows, columns = np.mgrid[:height, :width]
    np.testing.assert_allclose(u, columns, atol=NEAR)
    np.testing.assert_allclose(v, rows, atol=NEAR)


@given(clouds())
def test_a_camera_that_looks_at_a_point_has_it_ahead(points):
    eye, target = points[:2]
    up = np.array([0.1, 0.2, 1.0])
    (ahead,) = transform(invert(look_at(eye, target, up=up)), target[None])
    np.testing.assert_allclose(ahead, [0, 0, np.linalg.norm(target - eye)], atol=1e-7)
