"""Alignment against known motions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egosim_jax.geometry import transform, umeyama
from egosim_jax.state.align import align_cameras
from egosim_jax.types import InputError


def motion(scale=1.0, seed=0):
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.random(rng=rng).as_matrix()
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


def cloud(count=40, seed=1):
    return np.random.default_rng(seed).normal(size=(count, 3))


@pytest.mark.parametrize(("scaled", "scale"), [(False, 1.0), (True, 1.0), (True, 0.3)])
@pytest.mark.parametrize("seed", range(5))
def test_a_known_motion_is_found_exactly(scaled, scale, seed):
    truth = motion(scale, seed)
    found = umeyama(cloud(), transform(truth, cloud()), scaled=scaled)
    np.testing.assert_allclose(found, truth, atol=1e-10)


def test_rotations_agree_with_scipys_solution_on_noisy_points():
    points, targets = cloud(), transform(motion(), cloud()) + 0.1 * cloud(seed=2)
    found = umeyama(points, targets)
    middle, aim = points.mean(axis=0), targets.mean(axis=0)
    other = Rotation.align_vectors(targets - aim, points - middle)[0]
    np.testing.assert_allclose(found[:3, :3], other.as_matrix(), atol=1e-10)
    np.testing.assert_allclose(found[:3, 3], aim - other.apply(middle), atol=1e-10)


def test_the_scale_of_noisy_points_is_the_best_one():
    points, targets = cloud(), transform(motion(0.5), cloud()) + 0.05 * cloud(seed=2)

    def error(matrix):
        return np.square(transform(matrix, points) - targets).sum()

    found = umeyama(points, targets, scaled=True)
    for factor in (0.999, 1.001):
        other = found.copy()
        other[:3, :3] *= factor
        other[:3, 3] = targets.mean(axis=0) - other[:3, :3] @ points.mean(axis=0)
        assert error(found) < error(other)


def test_a_mirror_image_is_aligned_by_a_rotation():
    found = umeyama(cloud(), cloud() * [1, 1, -1])
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize("points", [cloud(2), np.outer(np.arange(5.0), [1, 2, 3])])
def test_too_few_or_collinear_points_are_refused(points):
    with pytest.raises(InputError, match="at least three that are non-collinear"):
        umeyama(points, points)


def cameras(count=6):
    return np.stack([motion(seed=10 + k) for k in range(count)])


@pytest.mark.parametrize("distance_m", [1, 1e-3])
@pytest.mark.parametrize(
    ("method", "scale"), [("centers", 0.4), ("orientations", 1.0), ("orientations and scale", 0.4)]
)
def test_cameras_known_in_both_give_the_motion_between(method, scale, distance_m):
    truth = motion(scale)
    there, here = cameras(), cameras()
    there[:, :3, 3] *= distance_m
    here[:, :3, :3] = truth[:3, :3] / scale @ there[:, :3, :3]
    here[:, :3, 3] = transform(truth, there[:, :3, 3])
    np.testing.assert_allclose(align_cameras(there, here, method=method), truth, atol=1e-10)


def test_one_camera_is_enough_for_a_rigid_alignment_and_leaves_the_scale_at_one():
    truth = motion()
    there = cameras(1)
    found = align_cameras(there, truth @ there, method="orientations and scale")
    np.testing.assert_allclose(found, truth, atol=1e-10)


@pytest.mark.parametrize(("factor", "scale"), [(99, 99), (101, 1), (-1, 1)])
def test_a_scale_that_is_noise_is_one(factor, scale):
    there, here = cameras(), cameras()
    here[:, :3, 3] *= factor
    found = align_cameras(there, here, method="orientations and scale")
    np.testing.assert_allclose(found[:3, :3], scale * np.eye(3), atol=1e-10)


def test_a_camera_that_is_not_finite_is_named():
    poses = cameras()
    poses[4, 1] = np.nan
    with pytest.raises(InputError, match="Camera pose 4 is not finite"):
        align_cameras(poses, cameras())
