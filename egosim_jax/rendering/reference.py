"""Renderer in NumPy, and Open3D for meshes, the reference for `jitted`; it does not import jax.

A point at depth z that projects to (u, v) is a square of p x p pixels: those (i, j) with
-p/2 <= i - u < p/2 and -p/2 <= j - v < p/2. A pixel sees the nearest of the points that cover it;
at equal depth, the first. Points of one pixel leave gaps between them; a view closes those that are
at most two pixels wide (`close_gaps`). A joint is a sphere, a bone the tube between two joints; a
pixel shows the shape that its ray meets first, without shading.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from egosim_jax.geometry import invert, pixel_rays, project, transform
from egosim_jax.rendering.mesh import AMBIENT, DIFFUSE, MovingMesh, vertex_normals
from egosim_jax.rendering.skeleton import (
    BONE_RADIUS_M,
    FAR_M,
    GAMMA,
    JOINT_RADIUS_M,
    NEAR_M,
    SKELETONS,
)
from egosim_jax.runtime.open3d import load_open3d
from egosim_jax.types import Cameras, InputError, Kind, Motion, SceneState, View

Paths = Sequence[tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "f 4 4"]]]
"""Points that move, and their motion in the world from the first frame to each frame."""
_CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T > 0
NO_POINT = np.iinfo(np.uint64).max
"""Key of a pixel that sees no point."""
GAP_MARGIN_PX = 2
"""Distance in pixels of the farthest points that decide whether a pixel is in a gap."""


def splat(
    points_m: Float[np.ndarray, "n 3"],
    cameras: Cameras,
    *,
    point_px: int,
    paths: Paths | None = None,
) -> tuple[Float32[np.ndarray, "f h w"], Int[np.ndarray, "f h w"]]:
    """Return depth in meters and index of the point seen by each pixel; infinite and -1 if none.

    Points that are not finite, nearer than 1 cm or farther than 100 m are not drawn. `paths` moves
    points.
    """
    shape = (len(cameras.world_from_camera), cameras.height, cameras.width)
    depth, index = np.full(shape, np.inf, np.float32), np.full(shape, -1)
    (known,) = np.nonzero(np.isfinite(points_m).all(axis=1))
    points, focal = points_m[known].astype(float), cameras.intrinsics_px.astype(np.float32)
    rows, columns = (size + point_px - 1 for size in shape[1:])
    for frame, world_from_camera in enumerate(cameras.world_from_camera):
        camera_from_world = invert(world_from_camera)
        local = transform(camera_from_world, points)
        for moves, motion in paths or ():
            moved = moves[known]
            local[moved] = transform(camera_from_world @ motion[frame], points[moved])
        local = local.astype(np.float32)
        drawable = (local[:, 2] >= NEAR_M) & (local[:, 2] <= FAR_M)
        local, number = local[drawable], known[drawable].astype(np.uint64)
        u, v = project(focal, local)
        # One key for depth and number: the bits of positive floats sort as the floats do.
        keys = local[:, 2].copy().view(np.uint32).astype(np.uint64) << 32 | number
        # The nearest point whose square begins at a pixel, then the nearest of the squares over it.
        column, row = (np.ceil(x - point_px / 2).astype(int) + point_px - 1 for x in (u, v))
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        best = np.full(rows * columns, NO_POINT)
        np.minimum.at(best, row[inside] * columns + column[inside], keys[inside])
        best = best.reshape(rows, columns)
        best = reduce(np.minimum, [best[y : y + shape[1]] for y in range(point_px)])
        best = reduce(np.minimum, [best[:, x : x + shape[2]] for x in range(point_px)])
        drawn = best != NO_POINT
        depth[frame][drawn] = (best[drawn] >> 32).astype(np.uint32).view(np.float32)
        index[frame][drawn] = (best[drawn] & 0xFFFFFFFF).astype(int)
    return depth, index


def paint(
    index: Int[np.ndarray, "f h w"], colors: UInt8[np.ndarray, "n 3"], *, gamma: bool
) -> UInt8[np.ndarray, "f h w 3"]:
    """Return the image of the visible points, black where no point is visible.

    `gamma` applies the original renderer's color curve, c -> c^(1/2.2).
    """
    colors = np.concatenate([GAMMA[colors] if gamma else colors, np.zeros((1, 3), np.uint8)])
    return colors[index]


def unobserved(
    index: Int[np.ndarray, "f h w"], *, dilate: bool = False
) -> UInt8[np.ndarray, "f h w"]:
    """Return the mask, 255 where no point is seen.

    In training data, the mask's points are twice as large as the image's. A view of the state has
    points of one size, so `dilate` widens the mask's observed part by a pixel instead.
    """
    drawn = index >= 0
    if not dilate:
        return np.where(drawn, 0, 255).astype(np.uint8)
    import cv2

    square = np.ones((3, 3), np.uint8)
    wide = np.stack([cv2.dilate(frame.astype(np.uint8), square) for frame in drawn])
    return np.where(wide > 0, 0, 255).astype(np.uint8)


def render(
    state: SceneState, cameras: Cameras, *, point_px: int, motion: Motion | None = None
) -> View:
    """Render a state along a camera path: Π of EgoSim's section 3.2.

    Objects follow a predicted motion, if one is given. Where they uncover what no point shows, the
    frames still have their image of before: a model draws it better from there than from a hole,
    and the depth is infinite. Gaps between points of one pixel are closed. Raises `InputError` if
    the first frame shows no point.
    """
    paths = paths_of(state, motion)
    depth_m, index = _seen_points(state, cameras, point_px, paths)
    check_visible(index[0], len(state.points_m))
    drawn = index
    if paths:
        _, before = _seen_points(state, cameras, point_px, ())
        drawn = np.where(index < 0, before, index)
    return View(
        frames=paint(drawn, state.colors, gamma=False),
        mask=unobserved(drawn, dilate=True),
        depth_m=depth_m,
        object_ids=np.append(state.object_ids, np.int32(0))[index],
    )


def _seen_points(
    state: SceneState, cameras: Cameras, point_px: int, paths: Paths
) -> tuple[Float32[np.ndarray, "f h w"], Int[np.ndarray, "f h w"]]:
    """Return depth and index of the point seen by each pixel, with gaps closed (`splat`)."""
    if point_px == 1:
        return close_gaps(*splat(state.points_m, add_margin(cameras), point_px=1, paths=paths))
    return splat(state.points_m, cameras, point_px=point_px, paths=paths)


def paths_of(state: SceneState, motion: Motion | None) -> Paths:
    """Return the points of each object that moves, and its motion in each frame."""
    paths = {} if motion is None else motion.paths
    return [(state.object_ids == number, path.motion) for number, path in paths.items()]


def add_margin(cameras: Cameras) -> Cameras:
    """Return cameras whose images are larger by `GAP_MARGIN_PX` pixels on each side."""
    intrinsics = cameras.intrinsics_px.copy()
    intrinsics[:2, 2] += GAP_MARGIN_PX
    height, width = (size + 2 * GAP_MARGIN_PX for size in (cameras.height, cameras.width))
    return replace(cameras, intrinsics_px=intrinsics, height=height, width=width)


def close_gaps(
    depth_m: Float32[np.ndarray, "f r c"], index: Int[np.ndarray, "f r c"]
) -> tuple[Float32[np.ndarray, "f h w"], Int[np.ndarray, "f h w"]]:
    """Return depth and index without a margin of `GAP_MARGIN_PX`, with their gaps closed.

    A gap is a pixel that sees no point but is in the morphological closing, by a square of 3 x 3
    pixels, of the pixels that see one: wider unobserved areas keep their shape. It sees the
    farthest of the points around it, because next to an edge the surface behind is incomplete; at
    equal depth, the first.
    """
    import cv2

    drawn, square = (index >= 0).astype(np.uint8), np.ones((3, 3), np.uint8)
    closed = np.stack([cv2.morphologyEx(frame, cv2.MORPH_CLOSE, square) for frame in drawn])
    inside = np.s_[:, GAP_MARGIN_PX:-GAP_MARGIN_PX, GAP_MARGIN_PX:-GAP_MARGIN_PX]
    gap = (closed > drawn)[inside]
    frame, row, column = np.nonzero(gap)
    around = [
        (frame, row + GAP_MARGIN_PX + down, column + GAP_MARGIN_PX + right)
        for down in (-1, 0, 1)
        for right in (-1, 0, 1)
    ]
    numbers = np.stack([index[pixels] for pixels in around])
    depths = np.stack([depth_m[pixels] for pixels in around])
    depths[numbers < 0] = -np.inf
    farthest = depths.max(axis=0)
    numbers[depths < farthest] = np.iinfo(numbers.dtype).max
    depth_m, index = depth_m[inside].copy(), index[inside].copy()
    depth_m[gap], index[gap] = farthest, numbers.min(axis=0)
    return depth_m, index


def check_visible(index: Int[np.ndarray, "h w"], count: int) -> None:
    """Raise `InputError` if no pixel of the first frame sees one of the scene's points."""
    if (index < 0).all():
        raise InputError(
            f"None of the {count} points of the scene is visible in the first frame: the camera "
            "must look at the scene, from 1 cm to 100 m away."
        )


def draw_hands(
    joints_m: Float[np.ndarray, "f n j 3"], cameras: Cameras, *, kind: Kind
) -> tuple[UInt8[np.ndarray, "f h w 3"], Float32[np.ndarray, "f h w"]]:
    """Draw n hands; return the image and its depth, black and infinite where there is no hand.

    A hand with a non-finite joint is missing from that frame. Nothing nearer than 1 cm or behind
    the camera is drawn.
    """
    skeleton = SKELETONS[kind]
    frames, height, width = len(joints_m), cameras.height, cameras.width
    image = np.zeros((frames, height, width, 3), np.uint8)
    depth = np.full((frames, height, width), np.inf, np.float32)
    rays = pixel_rays(cameras.intrinsics_px, height=height, width=width)
    for frame, world_from_camera in enumerate(cameras.world_from_camera):
        for hand in joints_m[frame]:
            if not np.isfinite(hand).all():
                continue
            joints = transform(invert(world_from_camera), hand)
            shapes = [
                (j, j, JOINT_RADIUS_M, c) for j, c in zip(joints, skeleton.colors, strict=True)
            ]
            shapes += [
                (joints[a], joints[b], BONE_RADIUS_M, skeleton.colors[b]) for a, b in skeleton.bones
            ]
            for start, end, radius, color in shapes:
                window = _window(start, end, radius, cameras)
                met = _meet(rays[window], start, end, radius)
                nearer = met < depth[frame][window]
                depth[frame][window][nearer] = met[nearer]
                image[frame][window][nearer] = color
    return image, depth


def _window(
    start: np.ndarray, end: np.ndarray, radius: float, cameras: Cameras
) -> tuple[slice, slice]:
    """Return the rows and columns that may show a shape: the bounds of its projected box."""
    low, high = np.minimum(start, end) - radius, np.maximum(start, end) + radius
    if low[2] < NEAR_M:  # corners behind the camera cannot be projected; `_meet` clips
        return slice(0, cameras.height), slice(0, cameras.width)
    u, v = project(cameras.intrinsics_px, np.where(_CORNERS, high, low))
    return (
        slice(max(0, int(np.floor(v.min()))), max(0, int(np.ceil(v.max())) + 1)),
        slice(max(0, int(np.floor(u.min()))), max(0, int(np.ceil(u.max())) + 1)),
    )


def _meet(
    rays: Float[np.ndarray, "h w 3"],
    start: Float[np.ndarray, " 3"],
    end: Float[np.ndarray, " 3"],
    radius: float,
) -> Float[np.ndarray, "h w"]:
    """Return the depth at which rays with z = 1 enter a sphere (start = end) or tube, or infinity.

    With d and s the ray's direction and the start across the tube's axis, |t d - s| = r is a
    quadratic equation in t.
    """
    along = end - start
    length = np.linalg.norm(along)
    axis = along / length if length > 0 else np.zeros(3)
    across = rays - (rays @ axis)[..., None] * axis
    offset = start - (start @ axis) * axis
    a = (across**2).sum(axis=-1)
    b = across @ offset
    c = offset @ offset - radius**2
    discriminant = b**2 - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (b - np.sqrt(discriminant)) / a
        place = (t[..., None] * rays - start) @ axis
    hit = (t >= NEAR_M) & (place >= 0) & (place <= length)
    return np.where(hit, t, np.inf)


def draw_mesh(
    mesh: MovingMesh, cameras: Cameras
) -> tuple[UInt8[np.ndarray, "f h w 3"], Float32[np.ndarray, "f h w"]]:
    """Draw a mesh; return the image and its depth, black and infinite off the mesh.

    Triangles with a non-finite vertex are missing. Nothing nearer than 1 cm is drawn.
    """
    shape = len(mesh.vertices_m), cameras.height, cameras.width
    image, depth = np.zeros((*shape, 3), np.uint8), np.full(shape, np.inf, np.float32)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    for frame, pose in enumerate(cameras.world_from_camera):
        vertices = transform(invert(pose), mesh.vertices_m[frame])
        complete = np.isfinite(vertices).all(axis=1)[mesh.triangles].all(axis=1)
        if complete.any():
            _draw_triangles(image[frame], depth[frame], vertices, mesh, complete, rays)
    return image, depth


def draw_scene(
    vertices_m: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    colors: UInt8[np.ndarray, "v 3"],
    cameras: Cameras,
) -> tuple[UInt8[np.ndarray, "f h w 3"], UInt8[np.ndarray, "f h w"]]:
    """Draw a scene in the colors of its vertices, without light, along a camera path.

    Returns the image and the mask: 255, and black, where no triangle is seen. Raises `InputError`
    if the first frame shows none.
    """
    cast = _ray_caster(vertices_m, triangles)
    shape = len(cameras.world_from_camera), cameras.height, cameras.width
    image, mask = np.zeros((*shape, 3), np.uint8), np.full(shape, 255, np.uint8)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    for frame, pose in enumerate(cameras.world_from_camera):
        ways = rays @ pose[:3, :3].T
        _, seen, numbers, share = cast(pose[:3, 3] + NEAR_M * ways, ways)
        image[frame][seen] = np.rint(np.einsum("nk,nkc->nc", share, colors[triangles[numbers]]))
        mask[frame][seen] = 0
    if mask[0].all():
        raise InputError(
            f"None of the {len(triangles)} triangles of the scene is visible in the first frame: "
            "the camera must look at the scene, in the same world coordinates."
        )
    return image, mask


def _ray_caster(
    vertices_m: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], *, threads: int = 0
) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, ...]]:
    """Return a function of the starts and directions of rays, by Open3D.

    It returns their distances, which rays meet a triangle, and its number and the barycentric
    coordinates there. All cores cast the rays, or the number of `threads`.
    """
    o3d = load_open3d()

    scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
    scene.add_triangles(
        o3d.core.Tensor(vertices_m.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32))
    )

    def cast(starts: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
        rays = np.concatenate([starts, directions], axis=-1).astype(np.float32)
        hits = scene.cast_rays(o3d.core.Tensor(rays), nthreads=threads)
        distances = hits["t_hit"].numpy()
        seen = np.isfinite(distances)
        u, v = hits["primitive_uvs"].numpy()[seen].T
        return distances, seen, hits["primitive_ids"].numpy()[seen], np.stack([1 - u - v, u, v], 1)

    return cast


def _draw_triangles(
    image: UInt8[np.ndarray, "h w 3"],
    depth: Float32[np.ndarray, "h w"],
    vertices: Float[np.ndarray, "v 3"],
    mesh: MovingMesh,
    complete: np.ndarray,
    rays: Float[np.ndarray, "h w 3"],
) -> None:
    """Draw the given triangles of one frame, in camera coordinates."""
    triangles = mesh.triangles[complete]
    cast = _ray_caster(np.nan_to_num(vertices), triangles, threads=1)
    distance, seen, numbers, share = cast(NEAR_M * rays, rays)
    corners = triangles[numbers]
    normals = vertex_normals(np.where(np.isfinite(vertices), vertices, 0.0), triangles)
    normal, color = (np.einsum("nk,nkc->nc", share, x[corners]) for x in (normals, mesh.colors))
    depth[seen] = distance[seen] + np.float32(NEAR_M)
    towards = -rays[seen]
    size = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
    cosine = (normal * towards).sum(axis=1) / np.maximum(size, 1e-12)
    light = AMBIENT + DIFFUSE * np.maximum(cosine, 0)
    image[seen] = np.round(255 * np.clip(color * light[:, None], 0, 1))
