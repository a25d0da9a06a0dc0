"""Initial scene state from one RGB-D image."""

from __future__ import annotations

from collections.abc import Mapping
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from egosim_jax.geometry import pixel_rays, transform, upsample_intrinsics
from egosim_jax.state.silhouettes import unmix_colors
from egosim_jax.types import InputError, SceneState, check_counts
from egosim_jax.types.arrays import DepthMap, Mask, Matrix, Pose, RgbImage

DEPTH_M = (0.05, 50.0)
"""Minimum and maximum median depth, in meters."""
EDGE = 0.03
"""Maximum relative change of depth by interpolation; beyond it, a pixel keeps its own depth."""
STEEP = 4.0
"""Minimum step of the depth at an edge, in widths of a pixel's footprint: a slope of 76 degrees."""
MIN_SMEARED = 0.25
"""Minimum fraction of edges that are ramps; in a depth image with fewer, a ramp is a surface."""
MAX_RAMP_PX = 6
"""Maximum number of pixels between the two surfaces of an edge."""
FLAT = 0.01
"""Maximum relative bend of inverse depth over three pixels of a surface."""


@no_type_check  # shapes and dtypes are checked with messages for users
def state_from_depth(
    image: UInt8[np.ndarray, "_ _ 3"],
    depth_m: DepthMap,
    intrinsics_px: Matrix,
    world_from_camera: Pose,
    *,
    object_ids: Int[np.ndarray, "_ _"] | None = None,
    names: Mapping[int, str] | None = None,
    points_per_pixel: int = 1,
) -> SceneState:
    """Return the state of one RGB-D image without hands: points of the pixels with known depth.

    Depth is in meters along the camera's z axis; 0, NaN and infinity mean unknown. Pixel centers
    are at integer coordinates. `object_ids` has the object of each pixel, 0 for the background
    (`find_objects` finds them), and `names` their names; without it nothing has an id. Each pixel
    gives `points_per_pixel` squared points, interpolated: a camera that moves nearer by this factor
    sees no gaps. Pixels between two surfaces (`between_surfaces`) give none, and mixed colors at
    silhouettes are replaced (`unmix_colors`). Raises `InputError` if
    shapes or dtypes differ, if no depth is known, or if the depth does not look like meters.
    """
    check_counts({"points_per_pixel": points_per_pixel})
    valid = known_depth(image, depth_m, intrinsics_px, object_ids)
    ids = np.zeros(depth_m.shape, np.int32) if object_ids is None else object_ids
    matrix = upsample_intrinsics(np.asarray(intrinsics_px, float), points_per_pixel)
    if points_per_pixel > 1:
        image, depth_m, valid, ids = _split(image, depth_m, valid, ids, points_per_pixel)
    rays = pixel_rays(matrix, height=depth_m.shape[0], width=depth_m.shape[1])[valid]
    points = transform(world_from_camera, rays * depth_m[valid][:, None])
    ids = ids[valid].astype(np.int32)
    return SceneState(
        points_m=points.astype(np.float32),
        colors=unmix_colors(points, image[valid], ids, world_from_camera, intrinsics_px),
        object_ids=ids,
        last_seen=np.zeros(len(points), np.int32),
        intrinsics_px=intrinsics_px,
        names=dict(names or {}),
        provenance={"source": "depth image"},
    )


@no_type_check  # shapes and dtypes are checked with messages for users
def known_depth(
    image: UInt8[np.ndarray, "_ _ 3"],
    depth_m: DepthMap,
    intrinsics_px: Matrix,
    object_ids: Int[np.ndarray, "_ _"] | None = None,
) -> Mask:
    """Return the pixels with the depth of a surface: positive, finite, not between two surfaces.

    Raises `InputError` as `state_from_depth` does.
    """
    for name, value, rule, fits in (
        ("depth_m", depth_m, "(height, width)", np.ndim(depth_m) == 2),
        (
            "image",
            image,
            "uint8 (height, width, 3)",
            np.ndim(image) == 3 and image.shape[2] == 3 and image.dtype == np.uint8,
        ),
    ):
        if not fits:
            raise InputError(f"{name} is {value.dtype} {value.shape}: it must be {rule}.")
    height, width = depth_m.shape
    shapes = {"image": image.shape[:2]}
    if object_ids is not None:
        shapes["object_ids"] = object_ids.shape
    for name, shape in shapes.items():
        if shape != (height, width):
            raise InputError(
                f"{name} is {shape[1]}x{shape[0]} and depth_m is {width}x{height} pixels: they "
                "must have the same size. Resize one of them."
            )
    valid = np.isfinite(depth_m) & (depth_m > 0)
    if not valid.any():
        raise InputError(
            "depth_m has no positive finite value: at least one pixel must have depth."
        )
    median = float(np.median(depth_m[valid]))
    if not DEPTH_M[0] <= median <= DEPTH_M[1]:
        raise InputError(
            f"The median depth is {median:.4g}: in meters it must be from {DEPTH_M[0]} to "
            f"{DEPTH_M[1]}. Convert depth_m to meters (millimeters / 1000)."
        )
    smeared = between_surfaces(np.where(valid, depth_m, np.nan), float(intrinsics_px[0][0]))
    return valid & ~smeared


def between_surfaces(depth_m: DepthMap, focal_px: float) -> Mask:
    """Return the pixels whose depth is between two surfaces that they do not belong to.

    Along a row or a column, such pixels are a short steep ramp with a surface at each end. A sharp
    edge has no pixel on its ramp; where most edges are sharp, nothing is found. Depth is NaN where
    it is unknown.
    """
    near_edge = np.zeros(depth_m.shape, bool)
    edges = ramps = 0
    for depth, target in ((depth_m, near_edge), (depth_m.T, near_edge.T)):
        inverse = 1 / depth
        step = np.diff(depth, axis=1)
        limit = STEEP / focal_px * np.minimum(depth[:, :-1], depth[:, 1:])
        sign = np.where(np.abs(step) > limit, np.sign(step), 0)  # 0 for NaN, too
        flat = np.zeros(depth.shape, bool)  # three pixels of a surface, by the middle one
        bend = inverse[:, :-2] - 2 * inverse[:, 1:-1] + inverse[:, 2:]
        flat[:, 1:-1] = (sign[:, :-1] == 0) & (sign[:, 1:] == 0)
        flat[:, 1:-1] &= np.abs(bend) <= FLAT * inverse[:, 1:-1]
        for length in range(MAX_RAMP_PX + 1):
            # Columns: surface 0 to 2, ramp 3 to 2 + length, surface 3 + length to 5 + length.
            count = depth.shape[1] - length - 5
            if count < 1:
                break
            ramp = flat[:, 1 : 1 + count] & flat[:, 4 + length : 4 + length + count]
            first = sign[:, 2 : 2 + count]
            for column in range(length + 1):
                ramp &= (sign[:, 2 + column : 2 + column + count] == first) & (first != 0)
            edges += int(ramp.sum())
            ramps += int(ramp.sum()) if length else 0
            for column in range(3, 3 + length):
                target[:, column : column + count] |= ramp
    return near_edge & (ramps >= MIN_SMEARED * edges)


def _split(
    image: RgbImage, depth_m: DepthMap, valid: Mask, ids: Int[np.ndarray, "h w"], times: int
) -> tuple[
    UInt8[np.ndarray, "r c 3"],
    Float[np.ndarray, "r c"],
    Bool[np.ndarray, "r c"],
    Int[np.ndarray, "r c"],
]:
    """Return an RGB-D image with each pixel split into `times` x `times`.

    Inverse depth, which is affine on planes, is interpolated between known pixels. At an edge that
    would make points between two surfaces, so a pixel there keeps its own depth.
    """
    import cv2

    height, width = depth_m.shape
    size = times * width, times * height
    inverse = np.where(valid, 1 / np.where(valid, depth_m, 1), 0).astype(np.float64)
    weight, total = (
        cv2.resize(x, size, interpolation=cv2.INTER_LINEAR)
        for x in (valid.astype(np.float64), inverse)
    )
    mask, valid, ids = (
        np.repeat(np.repeat(x, times, axis=0), times, axis=1) for x in (inverse, valid, ids)
    )
    between = total / np.maximum(weight, 1e-12)
    smooth = np.abs(between - mask) <= EDGE * mask
    with np.errstate(divide="ignore"):
        fine = 1 / np.where(smooth, between, mask)
    return cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), fine, valid, ids
