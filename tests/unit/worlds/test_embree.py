"""Clips are the same with and without Open3D, and need little else where it is missing."""

import hashlib
import subprocess
import sys

import numpy as np
import open3d as o3d
import pytest

from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import (
    embree,
    make_sequence,
    primitives,
    raycast,
    state_after,
    to_triplet,
)
from egosim_jax.worlds.tabletop.bodies import LOOSE, build_loose
from egosim_jax.worlds.tabletop.raycast import crossings_above

SPEC = VideoSpec(frames=5, height=48, width=80)
ABSENT = "open3d tyro grain array_record av ftfy tokenizers matplotlib huggingface_hub"
"""Packages that a machine lacks which only makes clips and trains."""
CLIP = """
import hashlib
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import World, make_scripts, make_sequence, state_after, to_triplet
from egosim_jax.worlds.tabletop.attempts import make_attempts

spec = VideoSpec(frames=5, height=48, width=80)
first, second = make_sequence(3, spec=spec, clips=2)
triplet = to_triplet(second, state_after(first, first.state))
print(hashlib.sha256(triplet.prior.tobytes()).hexdigest())
next(make_attempts(2, spec=spec, kind="robot"))
script = next(make_scripts(3, spec=spec, kind="robot"))
World(scene=script.scene).execute(script.action)
"""
TRAINING = """
from egosim_jax import configs
from egosim_jax.generation.encoding import pack
from egosim_jax.io import weights
from egosim_jax.train import bundle, update
from egosim_jax.train.tasks import denoising, refining
from egosim_jax.worlds.tabletop import make_sequence, to_triplet

model = configs.get("tabletop")
pack([to_triplet(next(make_sequence(3, spec=model.video)))], model)
"""


def run_without(packages: str, code: str) -> str:
    code = f"import sys\nsys.modules.update(dict.fromkeys({packages!r}.split()))\n{code}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def clip_by(caster, seed: int, monkeypatch):
    monkeypatch.setattr(raycast, "rays_among", caster)
    kind = "robot" if seed % 2 else "human"
    return next(make_sequence(seed, spec=SPEC, kind=kind, black_cloths=1))


@pytest.mark.parametrize("seed", range(4))
def test_a_clip_by_embreex_is_that_of_open3d(seed, monkeypatch):
    clip = clip_by(embree._Open3D, seed, monkeypatch)
    other = clip_by(embree._Embreex, seed, monkeypatch)
    np.testing.assert_array_equal(other.ids, clip.ids)
    np.testing.assert_allclose(other.depth_m, clip.depth_m, rtol=0, atol=3e-7)
    np.testing.assert_array_equal(other.state.object_ids, clip.state.object_ids)
    np.testing.assert_allclose(other.state.points_m, clip.state.points_m, rtol=0, atol=5e-7)
    triplet, other_triplet = to_triplet(clip), to_triplet(other)
    np.testing.assert_array_equal(other_triplet.mask, triplet.mask)
    for name in ("target", "prior", "first_frame"):
        pixels = getattr(triplet, name).astype(int)
        off = np.abs(getattr(other_triplet, name) - pixels).max(axis=-1)
        assert (off > 0).sum() <= 3  # a point may fall into another pixel
        assert name == "prior" or off.max() <= 1


def test_clips_need_no_open3d(monkeypatch):
    monkeypatch.setattr(raycast, "rays_among", embree._Embreex)
    first, second = make_sequence(3, spec=SPEC, clips=2)
    prior = to_triplet(second, state_after(first, first.state)).prior
    expected = hashlib.sha256(prior.tobytes()).hexdigest()
    assert run_without(f"{ABSENT} rich jax flax", CLIP) == expected


def test_training_needs_few_packages():
    run_without(ABSENT, TRAINING)


def test_a_machine_without_both_packages_learns_their_names(monkeypatch):
    for package in ("open3d", "embreex"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=r"open3d-cpu, or the smaller pip install embreex\."):
        embree.rays_among([])


@pytest.mark.parametrize("radius", [0.021, 0.033, 1.0])
def test_primitives_are_those_of_open3d(radius):
    height, shapes = 0.7 * radius, o3d.geometry.TriangleMesh
    pairs = [
        (
            primitives.cuboid(np.array([radius, height, 2 * height])),
            shapes.create_box(radius, height, 2 * height),
        ),
        (primitives.sphere(radius, 24), shapes.create_sphere(radius, resolution=24)),
        (primitives.cylinder(radius, height, 40), shapes.create_cylinder(radius, height, 40, 1)),
        (primitives.cone(radius, height, 40), shapes.create_cone(radius, height, 40, 1)),
        (primitives.torus(radius, height, 40, 16), shapes.create_torus(radius, height, 40, 16)),
    ]
    for (vertices, triangles), expected in pairs:
        np.testing.assert_array_equal(vertices, np.asarray(expected.vertices))
        np.testing.assert_array_equal(triangles, np.asarray(expected.triangles))


@pytest.mark.parametrize("shape", LOOSE)
def test_crossings_above_points_are_those_of_open3d(shape):
    part = build_loose(shape, "red", (0.08, 0.08, 0.03), "plain").parts[0]
    scene = o3d.t.geometry.RaycastingScene()
    points = part.vertices_m.astype(np.float32)
    scene.add_triangles(o3d.core.Tensor(points), o3d.core.Tensor(part.triangles.astype(np.uint32)))
    places = np.random.default_rng(0).uniform(-0.06, 0.06, (200, 3)).astype(np.float32)
    upwards = np.tile(np.array([0, 0, 1], np.float32), (len(places), 1))
    rays = np.concatenate([places, upwards], axis=1)
    expected = scene.count_intersections(o3d.core.Tensor(rays)).numpy()
    assert expected.max() > 0
    found = [crossings_above(place, points, part.triangles) for place in places]
    np.testing.assert_array_equal(found, expected)


def test_a_point_below_edges_and_corners_is_inside():
    vertices, triangles = primitives.cuboid(np.array([2.0, 2.0, 2.0]))
    for place in np.array([[1, 1, 1], [1, 0.5, 1], [0.5, 1.5, 0.1]]):
        assert crossings_above(place, vertices, triangles) == 1
    vertices, triangles = primitives.sphere(1.0, 8)
    assert crossings_above(np.zeros(3), vertices, triangles) == 1  # below a pole
    assert crossings_above(np.array([0, 0, -2.0]), vertices, triangles) == 2
