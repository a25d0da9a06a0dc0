"""Rays among the shapes of the tabletop world."""

import numpy as np
import open3d as o3d
import pytest

from egosim_jax.worlds.tabletop.bodies import LOOSE, build_loose
from egosim_jax.worlds.tabletop.embree import Rays


@pytest.mark.parametrize("shape", sorted({*LOOSE} - {"cup"}))  # a cup's parts overlap
def test_rays_know_what_is_inside_a_shape(shape):
    part = build_loose(shape, "red", (0.08, 0.08, 0.03), "plain").parts[0]
    rays = Rays([(part.vertices_m, part.triangles)])
    scene = o3d.t.geometry.RaycastingScene()
    points = part.vertices_m.astype(np.float32)
    scene.add_triangles(o3d.core.Tensor(points), o3d.core.Tensor(part.triangles.astype(np.uint32)))
    axis = np.stack([np.zeros(20), np.zeros(20), np.linspace(-0.01, 0.1, 20)], axis=1)
    places = np.random.default_rng(0).uniform(-0.06, 0.06, (200, 3))
    places = np.concatenate([places, axis]).astype(np.float32)
    inside = scene.compute_occupancy(o3d.core.Tensor(places), nsamples=5).numpy() > 0
    assert inside.any()
    np.testing.assert_array_equal([rays.contain(place) for place in places], inside)
