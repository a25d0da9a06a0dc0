"""Moving triangle meshes, and their shading.

The only light is at the camera. A surface of color c in [0, 1] whose unit normal has the cosine k
with the direction towards the camera is drawn as

    c * (AMBIENT + DIFFUSE * max(0, k)),    clipped to [0, 1]

with the normal interpolated between vertices (Phong). Faces seen from behind have a negative
cosine, so only ambient light. Source: the hand videos of DWM (CVPR 2026), drawn by PyTorch3D's
rasterizer at pixel centers, without antialiasing and without the scene that may hide the hands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Float, Int, UInt8

from egosim_jax.types import InputError

Side = Literal["left", "right"]
HAND_COLORS: dict[Side, tuple[float, float, float]] = {
    "left": (0.5, 0.8, 0.5),
    "right": (0.8, 0.4, 0.4),
}
"""RGB in [0, 1] of hand meshes: DWM's."""
AMBIENT, DIFFUSE = 0.7, 0.6
"""Intensities of the light."""
MAX_BACKGROUND_SUM = 100
"""Maximum sum of the three color values of a pixel without a hand."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class MovingMesh:
    """Triangle mesh whose vertices move from frame to frame."""

    vertices_m: Float[np.ndarray, "f v 3"]
    """Vertices in the world in meters; NaN where a part is missing from a frame."""
    triangles: Int[np.ndarray, "t 3"]
    """Vertex indices of each triangle, counterclockwise as seen from outside."""
    colors: Float[np.ndarray, "v 3"]
    """RGB of each vertex in [0, 1]."""

    def __post_init__(self) -> None:
        """Check shapes, and that triangles and colors belong to the vertices."""
        shape = np.shape(self.vertices_m)
        count = shape[1] if len(shape) == 3 else 0
        if len(shape) != 3 or shape[2] != 3 or 0 in shape:
            raise InputError(f"vertices_m of a mesh has shape {shape}: it must be (f, v, 3).")
        if np.shape(self.colors) != (count, 3):
            raise InputError(
                f"colors of a mesh has shape {np.shape(self.colors)}: it must be ({count}, 3), an "
                "RGB value in [0, 1] for each vertex."
            )
        triangles = self.triangles
        if np.ndim(triangles) != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
            raise InputError(
                f"triangles of a mesh is {triangles.dtype} {np.shape(triangles)}: it must be "
                "integers (t, 3)."
            )
        if triangles.size and not 0 <= triangles.min() <= triangles.max() < count:
            raise InputError(
                f"Triangles name vertices {triangles.min()} to {triangles.max()}: there are "
                f"{count}, counted from 0."
            )


def join_meshes(meshes: Sequence[MovingMesh]) -> MovingMesh:
    """Join meshes that have the same number of frames into one."""
    starts = np.cumsum([0, *(mesh.vertices_m.shape[1] for mesh in meshes)])
    return MovingMesh(
        vertices_m=np.concatenate([mesh.vertices_m for mesh in meshes], axis=1),
        triangles=np.concatenate(
            [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
        ),
        colors=np.concatenate([mesh.colors for mesh in meshes]),
    )


def vertex_normals(
    vertices_m: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> Float[np.ndarray, "v 3"]:
    """Return the unit normal of each vertex: the area-weighted mean of its triangles' normals."""
    a, b, c = (vertices_m[triangles[:, k]] for k in range(3))
    faces = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices_m)
    for k in range(3):
        np.add.at(normals, triangles[:, k], faces)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def hand_mask(frames: UInt8[np.ndarray, "f h w 3"]) -> UInt8[np.ndarray, "f h w 3"]:
    """Return the silhouettes of a hand video: white where red, green and blue add up to over 100.

    This is the hand condition of a DWM ablation.
    """
    white = frames.astype(np.int32).sum(axis=-1, keepdims=True) > MAX_BACKGROUND_SUM
    return np.where(white, np.uint8(255), np.uint8(0)).repeat(3, axis=-1)
