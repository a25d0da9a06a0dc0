"""Shaded meshes: by formulas for a sphere, by a loop over triangles, and the same in JAX."""

import numpy as np
import pytest

from egosim_jax.geometry import look_at, pixel_rays, rotation_z, transform
from egosim_jax.rendering import hand_mesh, mesh_jitted, reference
from egosim_jax.rendering.mesh import MovingMesh, hand_mask
from egosim_jax.rendering.skeleton import SKELETONS
from egosim_jax.types import Cameras, InputError

HEIGHT, WIDTH = 24, 40
DIFFERENT = 2e-3
"""Share of pixels that may differ: rays through an edge, which float32 gives to either side."""


@pytest.fixture(params=[reference, mesh_jitted], ids=["numpy", "jax"])
def renderer(request):
    return request.param


def make_cameras(frames=1):
    up = np.array([0.0, 0.0, 1.0])
    eyes = [np.array([0.02 * i, -0.4, 0.12]) for i in range(frames)]
    return Cameras(
        world_from_camera=np.stack([look_at(e, np.array([0, 0.08, 0.0]), up=up) for e in eyes]),
        intrinsics_px=np.array([[33.0, 0, 19.3], [0, 31.0, 11.8], [0, 0, 1]]),
        height=HEIGHT,
        width=WIDTH,
    )


@pytest.fixture(scope="module")
def hands():
    """Two open hands in front of the cameras; the left one is missing from the last frame."""
    right = hand_mesh.REST_MM / 1000 + [0.12, 0, 0]
    left = hand_mesh.REST_MM / 1000 * [-1, 1, 1] - [0.12, 0, 0]
    joints = np.stack([[left, right], [left + 0.02, right - 0.01]])
    joints[1, 0] = np.nan
    return joints


def by_hand(mesh, cameras):
    """Depth by intersecting every ray with every triangle (Moller and Trumbore)."""
    shape = (len(mesh.vertices_m), cameras.height, cameras.width)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    depth = np.full(shape, np.inf)
    for frame, pose in enumerate(cameras.world_from_camera):
        local = (mesh.vertices_m[frame] - pose[:3, 3]) @ pose[:3, :3]
        for a, b, c in local[mesh.triangles]:
            if not np.isfinite([a, b, c]).all():
                continue
            h = np.cross(rays, c - a)
            det = h @ (b - a)
            with np.errstate(divide="ignore", invalid="ignore"):
                u, q = h @ -a / det, np.cross(-a, b - a)
                v, t = rays @ q / det, (c - a) @ q / det
                hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0.01)
            depth[frame] = np.where(hit & (t < depth[frame]), t, depth[frame])
    return depth


def soup(frames=2):
    """Triangles in front of, next to and behind the camera, some of them not finite."""
    rng = np.random.default_rng(0)
    center = rng.uniform([-0.5, -0.8, -0.3], [0.5, 0.8, 0.4], (frames, 60, 1, 3))
    vertices = (center + rng.normal(scale=0.12, size=(frames, 60, 3, 3))).reshape(frames, 180, 3)
    vertices[:, 7] = np.nan
    triangles = np.arange(180).reshape(60, 3)
    return MovingMesh(vertices_m=vertices, triangles=triangles, colors=rng.uniform(size=(180, 3)))


def test_depth_is_that_of_a_loop_over_triangles(renderer):
    mesh, cameras = soup(), make_cameras(2)
    _, depth = renderer.draw_mesh(mesh, cameras)
    expected = by_hand(mesh, cameras)
    seen = np.isfinite(expected)
    assert 0.2 < seen.mean() < 0.98
    assert (np.isfinite(depth) != seen).mean() <= DIFFERENT
    seen &= np.isfinite(depth)
    wrong = np.abs(depth[seen] - expected[seen]) > 1e-4
    assert wrong.mean() <= DIFFERENT


def test_a_sphere_is_shaded_by_its_normals(renderer):
    import open3d as o3d

    ball = o3d.geometry.TriangleMesh.create_sphere(0.2, resolution=40)
    vertices = np.asarray(ball.vertices) + [0, 0.3, 0]
    color = np.array([0.8, 0.4, 0.4])
    mesh = MovingMesh(
        vertices_m=vertices[None],
        triangles=np.asarray(ball.triangles),
        colors=np.tile(color, (len(vertices), 1)),
    )
    cameras = make_cameras()
    image, depth = renderer.draw_mesh(mesh, cameras)
    pose = cameras.world_from_camera[0]
    center = (np.array([0, 0.3, 0]) - pose[:3, 3]) @ pose[:3, :3]
    rays = pixel_rays(cameras.intrinsics_px, height=HEIGHT, width=WIDTH)
    a, b, c = (rays**2).sum(-1), rays @ center, center @ center - 0.2**2
    with np.errstate(invalid="ignore"):
        t = (b - np.sqrt(b**2 - a * c)) / a
    points = t[..., None] * rays
    cosine = -((points - center) / 0.2 * rays).sum(-1) / np.sqrt(a)
    expected = np.clip(255 * color * (0.7 + 0.6 * cosine[..., None]), 0, 255)
    inside = cosine > 0.3
    assert inside.sum() > 60
    np.testing.assert_allclose(depth[0][inside], t[inside], atol=2e-3)
    assert np.abs(image[0][inside] - expected[inside]).max() < 3
    assert not image[0][np.isnan(t)].any()


def test_the_two_renderers_draw_the_same_hands(hands):
    mesh, cameras = hand_mesh.pose_hands(hands), make_cameras(2)
    (first, near), (second, also) = (
        renderer.draw_mesh(mesh, cameras) for renderer in (reference, mesh_jitted)
    )
    assert first[0].any(axis=-1).mean() > 0.04
    differing = np.abs(first.astype(int) - second).max(axis=-1) > 1
    assert differing.mean() <= DIFFERENT
    assert (np.isfinite(near) != np.isfinite(also)).mean() <= DIFFERENT


def test_left_hands_are_green_right_ones_red_and_missing_ones_black(hands):
    image, _ = reference.draw_mesh(hand_mesh.pose_hands(hands), make_cameras(2))
    left, right = image[:, :, : WIDTH // 2], image[:, :, WIDTH // 2 :]
    assert left[0].any()
    assert not left[1].any()
    drawn = left[0][left[0].any(axis=-1)].astype(int)
    assert (drawn[:, 1] > drawn[:, 0]).all()
    for frame in right:
        drawn = frame[frame.any(axis=-1)].astype(int)
        assert (drawn[:, 0] > drawn[:, 1]).all()


def test_the_template_is_a_closed_surface_that_contains_its_joints():
    vertices, triangles, weights = hand_mesh.make_template()
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there, times = np.unique(edges, axis=0, return_counts=True)
    assert (times == 1).all()
    assert {*map(tuple, there)} == {*map(tuple, there[:, ::-1])}
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    volume = np.einsum("tc,tc->", a, np.cross(b, c)) / 6
    assert 2e-4 < volume < 6e-4
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    gap = np.linalg.norm(vertices[:, None] - hand_mesh.REST_MM / 1000, axis=-1).min(axis=0)
    np.testing.assert_allclose(1000 * gap, hand_mesh.RADII_MM, atol=8)


def test_the_mesh_moves_and_grows_with_its_joints():
    rest = hand_mesh.REST_MM / 1000
    template = hand_mesh.make_template()
    still = hand_mesh.pose_hands(rest[None, None], sides=["right"]).vertices_m[0]
    np.testing.assert_allclose(still, template.vertices_m, atol=1e-9)
    pose = np.eye(4)
    pose[:3, :3] = rotation_z(0.7) @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    pose[:3, 3] = [0.1, -0.2, 0.3]
    moved = transform(pose, 1.3 * rest)
    mesh = hand_mesh.pose_hands(moved[None, None], sides=["right"])
    np.testing.assert_allclose(
        mesh.vertices_m[0], transform(pose, 1.3 * template.vertices_m), atol=1e-9
    )


def test_a_bent_finger_takes_its_flesh_along():
    joints = hand_mesh.REST_MM / 1000
    tip = np.argmax(hand_mesh.make_template().weights, axis=1) == 7  # outermost bone of the index
    bent = joints.copy()
    bent[7:9] = joints[6] + [[0, 0, -0.024], [0, -0.02, -0.03]]
    vertices = hand_mesh.pose_hands(bent[None, None], sides=["right"]).vertices_m[0]
    a, b = bent[7], bent[8]
    share = np.clip((vertices[tip] - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    gap = np.linalg.norm(vertices[tip] - a - share[:, None] * (b - a), axis=1)
    assert tip.sum() > 50
    assert gap.max() < 0.013
    bones = SKELETONS["human"].bones
    other = ~np.isin(np.argmax(hand_mesh.make_template().weights, axis=1), [4, 5, 6, 7])
    still = hand_mesh.pose_hands(joints[None, None], sides=["right"]).vertices_m[0]
    assert bones[7].tolist() == [7, 8]
    np.testing.assert_allclose(vertices[other], still[other], atol=2e-3)


def test_a_left_hand_is_the_mirror_image_of_a_right_one():
    rest = hand_mesh.REST_MM / 1000
    right = hand_mesh.pose_hands(rest[None, None], sides=["right"])
    left = hand_mesh.pose_hands(rest[None, None] * [-1, 1, 1], sides=["left"])
    np.testing.assert_allclose(left.vertices_m, right.vertices_m * [-1, 1, 1], atol=1e-12)
    assert (left.triangles == right.triangles[:, ::-1]).all()


def test_grippers_and_wrong_meshes_are_refused():
    with pytest.raises(InputError, match="a gripper has no mesh"):
        hand_mesh.pose_hands(np.zeros((2, 1, 3, 3)), sides=["right"])
    with pytest.raises(InputError, match="left, right"):
        hand_mesh.pose_hands(np.zeros((2, 1, 21, 3)))
    good = soup()
    with pytest.raises(InputError, match="there are 180"):
        MovingMesh(vertices_m=good.vertices_m, triangles=good.triangles + 1, colors=good.colors)
    with pytest.raises(InputError, match="colors"):
        MovingMesh(vertices_m=good.vertices_m, triangles=good.triangles, colors=good.colors[:5])


def test_a_hand_mask_is_white_where_the_colors_add_up_to_over_100():
    frames = np.array([[[[0, 0, 0], [30, 40, 30], [30, 40, 31], [143, 226, 143]]]], np.uint8)
    assert hand_mask(frames)[0, 0].tolist() == [[0] * 3, [0] * 3, [255] * 3, [255] * 3]
