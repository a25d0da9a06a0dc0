"""A first scene state from one RGB-D image."""

from __future__ import annotations

from collections.abc import Mapping
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int, UInt8

from egosim_jax.geometry import pixel_rays, transform
from egosim_jax.types import InputError, SceneState

DEPTH_M = (0.05, 50.0)
"""Smallest and largest median depth in meters that is accepted."""


@no_type_check  # shapes and dtypes are checked with messages for users
def state_from_depth(
    image: UInt8[np.ndarray, "_ _ 3"],
    depth_m: Float[np.ndarray, "h w"],
    intrinsics_px: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
    *,
    object_ids: Int[np.ndarray, "_ _"] | None = None,
    names: Mapping[int, str] | None = None,
) -> SceneState:
    """Return the state of one RGB-D image without hands: one point per pixel with known depth.

    Depth is in meters along the camera's z axis; 0, NaN and infinity mean unknown. Pixel centers
    are at integer coordinates. Without `object_ids` all points are background. Raises `InputError`
    if shapes or dtypes differ, if no depth is known, and if depth does not look like meters.
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
                "must be of the same image. Resize one of them."
            )
    known = np.isfinite(depth_m) & (depth_m > 0)
    if not known.any():
        raise InputError(
            "depth_m has no positive finite value: at least one pixel must have depth."
        )
    median = float(np.median(depth_m[known]))
    if not DEPTH_M[0] <= median <= DEPTH_M[1]:
        raise InputError(
            f"The median depth is {median:.4g}: in meters it must be from {DEPTH_M[0]} to "
            f"{DEPTH_M[1]}. Convert depth_m to meters (millimeters / 1000)."
        )
    rays = pixel_rays(intrinsics_px, height=height, width=width)[known]
    points = transform(world_from_camera, rays * depth_m[known][:, None])
    ids = np.zeros(known.sum(), np.int32) if object_ids is None else object_ids[known]
    return SceneState(
        points_m=points.astype(np.float32),
        colors=image[known],
        object_ids=ids.astype(np.int32),
        last_seen=np.zeros(len(points), np.int32),
        intrinsics_px=intrinsics_px,
        names=dict(names or {}),
        provenance={"source": "depth image"},
    )
