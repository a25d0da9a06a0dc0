"""The renderers in NumPy and JAX agree with each other and with a scalar loop."""

import math
from dataclasses import replace

import numpy as np
import pytest

from egosim_jax import rendering
from egosim_jax.geometry import look_at, rotation_z, transform
from egosim_jax.rendering import Renderer, jitted, reference
from egosim_jax.types import Cameras, InputError, Motion, ObjectPath, SceneState

DIFFERENT = 1e-3
"""Share of pixels that may differ: points on a pixel's edge round to either side in float32."""
HEIGHT, WIDTH = 24, 40
RAW = [(238, 130, 238), (255, 99, 71), (230, 245, 250), (173, 255, 47), (0, 152, 191)]
MEASURED = [(247, 189, 247), (255, 167, 144), (244, 251, 253), (215, 255, 119), (0, 203, 224)]
"""Colors from thumb to little finger, and as measured on the published videos."""


@pytest.fixture(params=[reference, jitted], ids=["numpy", "jax"])
def renderer(request):
    return request.param


def make_cameras(frames=3):
    up = np.array([0.0, 0.0, 1.0])
    eyes = [np.array([0.1 * i, -1.0, 0.4]) for i in range(frames)]
    return Cameras(
        world_from_camera=np.stack(
            [look_at(eye, np.array([0.0, 0.2, 0.1]), up=up) for eye in eyes]
        ),
        intrinsics_px=np.array([[33.0, 0, 19.3], [0, 31.0, 11.8], [0, 0, 1]]),
        height=HEIGHT,
        width=WIDTH,
    )


@pytest.fixture(scope="module")
def scene():
    """Points in front of, next to and behind the camera, some duplicate, some not finite."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.5, -2.5, -1.0], [1.5, 1.5, 1.0], (600, 3))
    points[50:90] = points[:40]
    points[100] = np.nan
    points[101] = np.inf
    colors = rng.integers(0, 256, (600, 3), dtype=np.uint8)
    return points.astype(np.float32), colors


@pytest.fixture
def state(scene):
    points, colors = scene
    finite = np.isfinite(points).all(axis=1)
    return make_state(points[finite], colors[finite])


def splat_by_hand(points, cameras, size):
    shape = (len(cameras.world_from_camera), HEIGHT, WIDTH)
    depth, index = np.full(shape, np.inf), np.full(shape, -1)
    fx, fy = cameras.intrinsics_px[0, 0], cameras.intrinsics_px[1, 1]
    cx, cy = cameras.intrinsics_px[:2, 2]
    for f, pose in enumerate(cameras.world_from_camera):
        for n, point in enumerate(points):
            if not all(math.isfinite(value) for value in point):
                continue
            x, y, z = (
                sum(pose[r, c] * (point[r] - pose[r, 3]) for r in range(3)) for c in range(3)
            )
            if not 0.01 <= z <= 100:
                continue
            u, v = fx * x / z + cx, fy * y / z + cy
            for j in range(HEIGHT):
                for i in range(WIDTH):
                    covers = -size / 2 <= i - u < size / 2 and -size / 2 <= j - v < size / 2
                    if covers and z < depth[f, j, i]:
                        depth[f, j, i], index[f, j, i] = z, n
    return depth, index


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_the_three_splatters_agree(scene, size):
    points, _ = scene
    cameras = make_cameras()
    depth, index = splat_by_hand(points, cameras, size)
    for renderer in (reference, jitted):
        got_depth, got_index = map(np.asarray, renderer.splat(points, cameras, point_px=size))
        assert (got_index != index).mean() <= DIFFERENT
        same = (got_index == index) & (index >= 0)
        np.testing.assert_allclose(got_depth[same], depth[same], rtol=1e-5)
        assert np.isinf(got_depth[got_index < 0]).all()


def test_of_equally_near_points_the_first_is_seen(renderer):
    points = np.array([[0, 0, 0], [0, 0, 0]], np.float32)
    _, index = renderer.splat(points, make_cameras(1), point_px=2)
    assert sorted(set(np.asarray(index).ravel())) == [-1, 0]


def test_a_square_that_begins_outside_the_image_still_shows(renderer):
    cameras = Cameras(
        world_from_camera=np.eye(4)[None],
        intrinsics_px=np.array([[10.0, 0, 0], [0, 10.0, 0], [0, 0, 1]]),
        height=HEIGHT,
        width=WIDTH,
    )
    _, index = renderer.splat(np.array([[-0.1, -0.1, 1]], np.float32), cameras, point_px=4)
    rows, columns = np.nonzero(np.asarray(index)[0] == 0)
    assert set(rows) == set(columns) == {0}


def test_a_scene_behind_the_camera_is_black_and_not_observed(renderer, scene):
    points, colors = scene
    behind = points - np.array([0, 10, 0], np.float32)
    cameras = make_cameras()
    _, index = renderer.splat(behind, cameras, point_px=2)
    assert not np.asarray(renderer.paint(index, colors, gamma=True)).any()
    assert (np.asarray(renderer.unobserved(index)) == 255).all()


def test_gamma_lifts_the_colors_of_points(renderer, scene):
    points, colors = scene
    _, index = renderer.splat(points, make_cameras(), point_px=2)
    index = np.asarray(index)
    lifted, plain = (
        np.asarray(renderer.paint(index, colors, gamma=g)).astype(float) for g in (True, False)
    )
    assert np.abs(lifted - 255 * (plain / 255) ** (1 / 2.2)).max() <= 0.5 + 1e-9
    seen = index >= 0
    assert (plain[seen] == colors[index[seen]]).all()
    assert not plain[~seen].any()


def test_both_masks_against_the_image(renderer, scene):
    points, _ = scene
    cameras = make_cameras()
    _, twice = splat_by_hand(points, cameras, 4)
    _, large = renderer.splat(points, cameras, point_px=4)
    mask = np.asarray(renderer.unobserved(large))
    assert ((mask == 255) != (twice < 0)).mean() <= DIFFERENT
    _, index = renderer.splat(points, cameras, point_px=2)
    drawn = np.asarray(index) >= 0
    mask = np.asarray(renderer.unobserved(index, dilate=True))
    for f, j, i in np.ndindex(drawn.shape):
        around = drawn[f, max(0, j - 1) : j + 2, max(0, i - 1) : i + 2]
        assert mask[f, j, i] == (0 if around.any() else 255)


def make_hands(frames=3):
    """Two hands: one in front, one that reaches past the camera; missing in the last frame."""
    rng = np.random.default_rng(1)
    hands = rng.normal(scale=0.12, size=(frames, 2, 21, 3)) + [0.0, 0.0, 0.1]
    hands[:, 1] += [0.1, -0.9, 0.2]
    hands[-1, 1, 3] = np.nan
    return hands.astype(np.float32)


def hands_by_hand(joints, cameras, kind):
    """Find where every pixel's ray first enters a sphere or a tube."""
    if kind == "human":
        bones = [(0, 4 * f + 1) for f in range(5)]
        bones += [(4 * f + k, 4 * f + k + 1) for f in range(5) for k in range(1, 4)]
        lifted = [[round(255 * (c / 255) ** (1 / 2.2)) for c in color] for color in RAW]
        assert np.abs(np.array(lifted) - MEASURED).max() <= 1
        colors = [lifted[2], *(color for color in lifted for _ in range(4))]
    else:
        bones, colors = [(0, 1), (0, 2)], [RAW[2], RAW[0], RAW[1]]
    fx, fy = cameras.intrinsics_px[0, 0], cameras.intrinsics_px[1, 1]
    cx, cy = cameras.intrinsics_px[:2, 2]
    image = np.zeros((len(joints), HEIGHT, WIDTH, 3), np.uint8)
    depth = np.full(image.shape[:3], np.inf)
    for f, pose in enumerate(cameras.world_from_camera):
        shapes = []
        for hand in joints[f]:
            if np.isfinite(hand).all():
                local = [pose[:3, :3].T @ (joint - pose[:3, 3]) for joint in hand.astype(float)]
                shapes += [(p, p, 0.0055, c) for p, c in zip(local, colors, strict=True)]
                shapes += [(local[a], local[b], 0.00275, colors[b]) for a, b in bones]
        for j in range(HEIGHT):
            for i in range(WIDTH):
                ray = np.array([(i - cx) / fx, (j - cy) / fy, 1.0])
                for start, end, radius, color in shapes:
                    t = first_inside(ray, start, end, radius)
                    if 0.01 <= t < depth[f, j, i]:
                        depth[f, j, i], image[f, j, i] = t, color
    return image, depth


def first_inside(ray, start, end, radius):
    """Solve |part of (t ray - start) across the axis| = radius by the cross product."""
    axis = end - start
    if not axis.any():
        roots = np.roots([ray @ ray, -2 * ray @ start, start @ start - radius**2])
        return min(roots.real) if np.isreal(roots).all() else math.inf
    axis = axis / np.linalg.norm(axis)
    m, n = np.cross(ray, axis), np.cross(start, axis)
    roots = np.roots([m @ m, -2 * m @ n, n @ n - radius**2])
    if not np.isreal(roots).all():
        return math.inf
    t = min(roots.real)
    return t if 0 <= (t * ray - start) @ axis <= np.linalg.norm(end - start) else math.inf


@pytest.mark.parametrize("kind", ["human", "robot"])
def test_the_three_hand_renderers_agree(kind):
    cameras = make_cameras(2)
    hands = make_hands(2)[:, :, : 21 if kind == "human" else 3]
    image, depth = hands_by_hand(hands, cameras, kind)
    assert image.any(axis=(1, 2, 3)).all()
    for renderer in (reference, jitted):
        got, got_depth = map(np.asarray, renderer.draw_hands(hands, cameras, kind=kind))
        assert (got != image).any(axis=-1).mean() <= DIFFERENT
        same = (got == image).all(axis=-1) & np.isfinite(depth) & np.isfinite(got_depth)
        np.testing.assert_allclose(got_depth[same], depth[same], rtol=1e-4)


def test_a_hand_that_is_missing_or_behind_the_camera_is_not_drawn(renderer):
    hands = make_hands(3)
    hands[0, :, 0] = np.nan
    hands[1] -= np.array([0, 20, 0], np.float32)
    image, depth = map(np.asarray, renderer.draw_hands(hands, make_cameras(3), kind="human"))
    assert not image[:2].any()
    assert np.isinf(depth[:2]).all()
    assert image[2].any()


def test_both_renderers_are_a_renderer_by_name():
    assert rendering.get("numpy") is reference
    assert rendering.get("jax") is jitted
    assert isinstance(reference, Renderer)
    assert isinstance(jitted, Renderer)


def make_state(points, colors):
    return SceneState(
        points_m=points,
        colors=colors,
        object_ids=np.arange(len(points), dtype=np.int32) % 5,
        last_seen=np.zeros(len(points), np.int32),
        intrinsics_px=np.eye(3),
    )


@pytest.mark.parametrize("size", [1, 2])
def test_both_renderers_give_the_same_view(state, size):
    views = [r.render(state, make_cameras(), point_px=size) for r in (reference, jitted)]
    for name in ("frames", "mask", "depth_m", "object_ids"):
        expected, got = (getattr(view, name) for view in views)
        assert got.dtype == expected.dtype
        assert (got != expected).mean() <= DIFFERENT


FLAT = Cameras(
    world_from_camera=np.eye(4)[None],
    intrinsics_px=np.array([[30.0, 0, 0], [0, 30.0, 0], [0, 0, 1]]),
    height=HEIGHT,
    width=WIDTH,
)


@pytest.mark.parametrize("size", [1, 2])
def test_both_renderers_draw_objects_on_their_predicted_paths(state, size):
    ids = np.arange(len(state.points_m), dtype=np.int32) % 3
    state, cameras = replace(state, object_ids=ids), make_cameras()
    rng = np.random.default_rng(5)
    paths = {}
    for number in (1, 2):
        motion = np.repeat(np.eye(4)[None], 3, axis=0)
        motion[:, :3, :3] = rotation_z(0.1 * number)
        motion[1:, :3, 3] = rng.uniform(-0.3, 0.3, (2, 3))
        paths[number] = ObjectPath(motion=motion, causes=(), confidence=1.0)
    views = [
        module.render(state, cameras, point_px=size, motion=Motion(paths=paths))
        for module in (reference, jitted)
    ]
    still = reference.render(state, cameras, point_px=size)
    for frame in range(3):  # as a state whose points were moved before
        moved = state.points_m.copy()
        for number, path in paths.items():
            moved[ids == number] = transform(path.motion[frame], moved[ids == number].astype(float))
        alone = replace(cameras, world_from_camera=cameras.world_from_camera[frame : frame + 1])
        expected = reference.render(replace(state, points_m=moved), alone, point_px=size)
        hole = np.isinf(expected.depth_m[0])[..., None]
        frames = np.where(hole, still.frames[frame], expected.frames[0])
        for view in views:
            assert (view.object_ids[frame] != expected.object_ids[0]).mean() < DIFFERENT
            assert (view.frames[frame] != frames).mean() < DIFFERENT


def test_what_a_moved_object_uncovers_keeps_its_image_but_has_no_depth(renderer):
    wall = make_points(range(HEIGHT), range(10), 2.0)
    cup = make_points([8, 9, 10], [20, 21, 22], 1.0)
    state = gray((90, wall), (200, cup))
    state = replace(state, object_ids=np.repeat([0, 1], [len(wall), len(cup)]).astype(np.int32))
    moved = np.eye(4)
    moved[0, 3] = -15 / 30  # onto the wall: 15 pixels to the left
    motion = np.stack([np.eye(4), moved])
    path = Motion(paths={1: ObjectPath(motion=motion, causes=(), confidence=1.0)})
    cameras = replace(FLAT, world_from_camera=np.eye(4)[None].repeat(2, axis=0))
    view = renderer.render(state, cameras, point_px=1, motion=path)
    assert (view.frames[1, 8:11, 5:8] == 200).all()
    assert (view.object_ids[1, 8:11, 5:8] == 1).all()
    old = np.s_[1, 8:11, 20:23]
    assert (view.frames[old] == 200).all()
    assert (view.mask[old] == 0).all()
    assert np.isinf(view.depth_m[old]).all()
    assert (view.object_ids[old] == 0).all()
    assert (view.mask[:, :, 25:] == 255).all()


def make_points(rows, columns, depth):
    """Return a point at the center of every pixel of the given rows and columns of `FLAT`."""
    v, u = np.meshgrid(rows, columns, indexing="ij")
    points = np.stack([u / 30, v / 30, np.ones(u.shape)], axis=-1) * depth
    return points.reshape(-1, 3).astype(np.float32)


def gray(*levels_of_points):
    """Return a state of points in gray levels."""
    points = np.concatenate([points for _, points in levels_of_points])
    levels = np.repeat(
        [level for level, _ in levels_of_points], [len(points) for _, points in levels_of_points]
    )
    return make_state(points, np.repeat(levels[:, None], 3, axis=1).astype(np.uint8))


def close_by_hand(depth, index):
    """Close the gaps of a frame pixel by pixel; the result has a margin of two pixels less."""
    closed_depth, closed_index = depth[2:-2, 2:-2].copy(), index[2:-2, 2:-2].copy()
    for j, i in np.argwhere(closed_index < 0):
        # The gap and the 8 pixels around it each have a point among the 9 pixels around them.
        corners = [(j + down, i + right) for down in (1, 2, 3) for right in (1, 2, 3)]
        if all((index[y - 1 : y + 2, x - 1 : x + 2] >= 0).any() for y, x in corners):
            seen = [(-depth[y, x], index[y, x]) for y, x in corners if index[y, x] >= 0]
            closed_depth[j, i], closed_index[j, i] = min(seen)
            closed_depth[j, i] *= -1
    return closed_depth, closed_index


def test_gaps_are_closed_as_by_hand(renderer, scene):
    points = np.concatenate([scene[0], scene[0] * np.float32(0.9)])
    cameras = reference.add_margin(make_cameras())
    depth, index = map(np.asarray, reference.splat(points, cameras, point_px=1))
    expected_depth, expected = map(np.stack, zip(*map(close_by_hand, depth, index), strict=True))
    before, after = (index[:, 2:-2, 2:-2] >= 0).mean(), (expected >= 0).mean()
    assert before + 0.05 < after < 0.9
    got_depth, got = map(np.asarray, renderer.close_gaps(depth, index.astype(np.int32)))
    np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(got_depth, expected_depth)


def test_seams_and_outline_of_a_moved_object_are_closed(renderer):
    """Its points now have a distance of 1.5 pixels; around its former place a pixel is missing."""
    background = np.ones((HEIGHT, WIDTH), bool)
    background[6:15, 22:34] = False
    background[7:14, 23:33] = True
    background[3:15, 3:15] = False
    state = gray(
        (50, make_points(np.arange(HEIGHT), np.arange(WIDTH), 2)[background.ravel()]),
        (200, make_points(np.arange(3, 15, 1.5), np.arange(3, 15, 1.5), 1)),
    )
    assert (np.asarray(renderer.splat(state.points_m, FLAT, point_px=1)[1]) < 0).sum() > 100
    view = renderer.render(state, FLAT, point_px=1)
    shown = view.frames[0, ..., 0]
    assert (shown[4:13, 4:13] == 200).all()
    assert (shown[:, 14:] == 50).all()
    assert (view.mask == 0).all()
    np.testing.assert_array_equal(view.depth_m[0], np.where(shown == 200, 1, 2))


def test_a_gap_next_to_an_edge_shows_what_is_behind_the_edge(renderer):
    rows = np.arange(HEIGHT)
    near, far = make_points(rows, np.arange(10), 1), make_points(rows, np.arange(11, WIDTH), 2)
    view = renderer.render(gray((200, near), (50, far)), FLAT, point_px=1)
    assert (view.frames[0, 1:-1, :10] == 200).all()
    assert (view.frames[0, 1:-1, 10:] == 50).all()


@pytest.mark.parametrize("hole", [np.s_[5:8, 9:12], np.s_[:3, 30:], np.s_[10:21, 3:33]])
def test_an_unobserved_area_of_three_pixels_or_more_keeps_its_shape(renderer, hole):
    unobserved = np.zeros((HEIGHT, WIDTH), bool)
    unobserved[hole] = True
    points = make_points(np.arange(HEIGHT), np.arange(WIDTH), 1)[~unobserved.ravel()]
    view = renderer.render(gray((90, points)), FLAT, point_px=1)
    assert ((view.frames == 0).all(axis=-1) == unobserved).all()
    assert (np.isinf(view.depth_m) == unobserved).all()


def test_a_gap_at_the_border_needs_points_beyond_it(renderer):
    columns = np.arange(2, WIDTH)
    inner = make_points(np.arange(HEIGHT), columns, 1)
    view = renderer.render(gray((90, inner)), FLAT, point_px=1)
    assert not view.frames[:, :, :2].any()
    outer = make_points(np.arange(-2, HEIGHT + 2), [-1], 1)
    view = renderer.render(gray((90, inner), (90, outer)), FLAT, point_px=1)
    assert view.frames[:, 1:-1].all()


def test_views_of_larger_points_show_the_points_alone(renderer, state):
    cameras = make_cameras()
    for size in (2, 3):
        depth, index = renderer.splat(state.points_m, cameras, point_px=size)
        view = renderer.render(state, cameras, point_px=size)
        np.testing.assert_array_equal(view.depth_m, depth)
        np.testing.assert_array_equal(view.frames, renderer.paint(index, state.colors, gamma=False))


def test_a_first_frame_without_points_is_refused(renderer):
    state = make_state(np.float32([[0, -5, 0]]), np.zeros((1, 3), np.uint8))
    with pytest.raises(InputError, match=r"None of the 1 points of the scene is visible"):
        renderer.render(state, make_cameras(), point_px=2)


def test_hands_close_to_the_camera_are_drawn_alike():
    """Some shapes reach through the near plane, and they fill more than one chunk."""
    rng = np.random.default_rng(2)
    cameras = make_cameras(2)
    forward, eye = cameras.world_from_camera[:, :3, 2], cameras.world_from_camera[:, :3, 3]
    near = (eye + 0.02 * forward)[:, None, None] + rng.normal(scale=0.02, size=(2, 9, 21, 3))
    images, depths = zip(
        *(r.draw_hands(near, cameras, kind="human") for r in (reference, jitted)), strict=True
    )
    assert images[0].any(axis=-1).mean() > 0.2
    assert (images[0] != images[1]).any(axis=-1).mean() <= DIFFERENT
    same = (images[0] == images[1]).all(axis=-1) & np.isfinite(depths[0])
    np.testing.assert_allclose(depths[1][same], depths[0][same], rtol=1e-3)
