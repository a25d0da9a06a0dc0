"""A ray-cast textured room with a box on its floor, seen by known cameras."""

from __future__ import annotations

import functools

import cv2
import numpy as np

from egosim_jax.perception.video.estimates import Lens
from egosim_jax.types import Cameras
from tests.scenes import pinhole

HEIGHT, WIDTH, FOCAL = 240, 320, 180.0
STILL = np.zeros(3)
TEXELS_PER_M = 64


def _rectangles() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return corner and two edges of each rectangle, in meters; the camera looks along z."""
    a = np.array
    room = [
        (a([-3, -2, 3.5]), a([6, 0, 0]), a([0, 3.5, 0])),
        (a([-3, 1.0, -0.5]), a([6, 0, 0]), a([0, 0, 4.0])),
        (a([-1.8, -2, -0.5]), a([0, 0, 4.0]), a([0, 3.5, 0])),
        (a([1.9, -2, -0.5]), a([0, 0, 4.0]), a([0, 3.5, 0])),
        (a([-3, -1.7, -0.5]), a([6, 0, 0]), a([0, 0, 4.0])),
    ]
    for x, z, size in ((-0.7, 1.6, 0.7), (0.6, 2.2, 0.9), (0.1, 1.2, 0.4)):
        top = 1.0 - size
        room += [
            (a([x - size / 2, top, z]), a([size, 0, 0]), a([0, size, 0])),
            (a([x - size / 2, top, z]), a([size, 0, 0]), a([0, 0, size])),
            (a([x - size / 2, top, z]), a([0, 0, size]), a([0, size, 0])),
            (a([x + size / 2, top, z]), a([0, 0, size]), a([0, size, 0])),
        ]
    return [(c.astype(float), u.astype(float), v.astype(float)) for c, u, v in room]


@functools.cache
def _texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.zeros((512, 512, 3), np.float32)
    for size in (8, 24, 64, 128):
        noise = rng.normal(size=(size, size, 3)).astype(np.float32)
        image += cv2.resize(noise, (512, 512), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * image, 0, 255)


def render(cameras: Cameras, *, lens: Lens | None = None, seed: int = 0) -> np.ndarray:
    """Return the uint8 frames of cameras, distorted by a lens if given."""
    rows, columns = np.mgrid[: cameras.height, : cameras.width].astype(float)
    x = np.stack([columns, rows], axis=-1) - cameras.intrinsics_px[:2, 2]
    x /= cameras.intrinsics_px[0, 0] if lens is None else lens.focal_px
    if lens is not None:
        straight = x
        for _ in range(30):
            straight = x / (1 + lens.radial * (straight**2).sum(-1, keepdims=True))
        x = straight
    rays = np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)
    textures = [_texture(seed * 100 + i) for i in range(len(_rectangles()))]
    return np.stack([_frame(pose, rays, textures) for pose in cameras.world_from_camera])


def _frame(pose: np.ndarray, rays: np.ndarray, textures: list[np.ndarray]) -> np.ndarray:
    directions = rays @ pose[:3, :3].T
    nearest = np.full(rays.shape[:2], np.inf)
    image = np.zeros(rays.shape, np.float32)
    for (corner, u, v), texture in zip(_rectangles(), textures, strict=True):
        normal = np.cross(u, v)
        depth = ((corner - pose[:3, 3]) @ normal) / (directions @ normal + 1e-12)
        hit = pose[:3, 3] + depth[..., None] * directions - corner
        s, t = hit @ u / (u @ u), hit @ v / (v @ v)
        seen = (depth > 0.05) & (depth < nearest) & (s >= 0) & (s < 1) & (t >= 0) & (t < 1)
        place = TEXELS_PER_M * np.stack([s * np.linalg.norm(u), t * np.linalg.norm(v)], axis=-1)
        colors = cv2.remap(
            texture, place.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
        )
        image[seen], nearest[seen] = colors[seen], depth[seen]
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def path(
    count: int, *, move: np.ndarray = STILL, turn_deg: np.ndarray = STILL, portrait: bool = False
) -> Cameras:
    """Return cameras that start at the identity and move and turn evenly, with a little sway."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for frame in range(count):
        share = frame / max(count - 1, 1)
        sway = np.sin(2 * np.pi * share) * np.array([0.0, 0.05, 0.02])
        poses[frame, :3, :3] = cv2.Rodrigues(np.radians(turn_deg) * share)[0]
        poses[frame, :3, 3] = (move + sway) * share if np.any(move) else 0
    height, width = (WIDTH, HEIGHT) if portrait else (HEIGHT, WIDTH)
    return pinhole(poses, FOCAL, height, width)
