"""Distorting lenses, and the remapping of their images to a pinhole camera.

A lens projects rays `x y 1` (or any point in front of the camera) to pixels. r is the distance from
the axis on the plane z = 1, and theta = atan r is the angle to the axis:

    brown    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), y' likewise;
             COLMAP's SIMPLE_RADIAL, RADIAL and OPENCV, Intel's and nerfstudio's `k1 k2 p1 p2 k3`
    fisheye  theta' = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), along the ray's
             direction; OPENCV_FISHEYE
    fisheye624  the same with six radial terms, then tangential p0 p1 and thin prism s0 .. s3; as
             Project Aria defines it

Pixels are f x' + c, with pixel centers at integers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.geometry import pixel_rays
from egosim_jax.types import InputError

MAX_SPREAD = 0.01
"""Maximum relative difference of a parameter between images of one camera."""
MAX_ZOOM = 2.0
"""Maximum zoom to avoid black borders."""
PINHOLE_PX = 0.5
"""Maximum distortion in pixels of a lens that counts as a pinhole."""
_COUNTS = {"brown": 5, "fisheye": 4, "fisheye624": 12}


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Lens:
    """Camera with a distorting lens."""

    model: Literal["brown", "fisheye", "fisheye624"]
    """Model of the distortion."""
    coefficients: tuple[float, ...]
    """Coefficients of the model: k1 k2 p1 p2 k3; k1 to k4; or k0 to k5, p0 p1, s0 to s3."""
    intrinsics_px: Float[np.ndarray, "3 3"]
    """Focal lengths and principal point in pixels."""
    height: int
    """Height of the image in pixels."""
    width: int
    """Width of the image in pixels."""

    def __post_init__(self) -> None:
        """Check the number of coefficients, and that all are finite and plausible."""
        values = np.asarray(self.coefficients, float)
        if values.shape != (_COUNTS[self.model],) or not (np.abs(values) < 100).all():
            raise InputError(
                f"A lens {self.model} has {self.coefficients}: it must have {_COUNTS[self.model]} "
                "finite coefficients below 100."
            )

    def project(self, points: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 2"]:
        """Project points in camera coordinates, with z above 0, to columns and rows in pixels."""
        x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
        distort = _brown if self.model == "brown" else _fisheye
        x, y = distort(x, y, [float(value) for value in self.coefficients])
        (fx, skew, cx), (_, fy, cy), _ = np.asarray(self.intrinsics_px, float)
        return np.stack([fx * x + skew * y + cx, fy * y + cy], axis=-1)

    def unproject(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return x and y of the pixels' rays at z = 1, by Newton's method; NaN outside the lens.

        A pixel is outside the lens if the method does not converge to a thousandth of a pixel.
        """
        center = self.intrinsics_px[:2, 2]
        focal = self.intrinsics_px[[0, 1], [0, 1]]
        rays = (pixels - center) / focal
        with np.errstate(all="ignore"):
            for _ in range(20):
                found, step = self._project_rays(rays), 1e-6
                columns = [
                    (self._project_rays(rays + step * axis) - found) / step for axis in np.eye(2)
                ]
                jacobian = np.stack(columns, axis=-1)
                determinant = np.linalg.det(jacobian)[:, None]
                miss = pixels - found
                a, b, c, d = (jacobian[:, i, j, None] for i in (0, 1) for j in (0, 1))
                change = np.concatenate(
                    [d * miss[:, :1] - b * miss[:, 1:], a * miss[:, 1:] - c * miss[:, :1]], axis=1
                )
                rays = rays + change / determinant
            error = np.abs(self._project_rays(rays) - pixels).max(axis=1)
        rays[~(error < 1e-3)] = np.nan
        return rays

    def _project_rays(self, rays: np.ndarray) -> np.ndarray:
        return self.project(np.concatenate([rays, np.ones_like(rays[:, :1])], axis=1))

    def is_pinhole(self) -> bool:
        """Return True if the distortion is below `PINHOLE_PX` everywhere in the image."""
        pixels = _grid(self.height, self.width, 33)
        return bool(np.abs(self.project(_rays(self.intrinsics_px, pixels)) - pixels).max() < (
            PINHOLE_PX
        ))  # fmt: skip


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Remap:
    """Remapping of a lens's images to a pinhole camera of the same size."""

    lens: Lens
    """Lens of the images."""
    intrinsics_px: Float[np.ndarray, "3 3"]
    """Intrinsics of the pinhole camera, whose image has no black borders."""

    @classmethod
    def of(cls, lens: Lens) -> Remap:
        """Return the remapping with the smallest zoom that leaves no black borders."""
        height, width = lens.height, lens.width
        focal = float(np.sqrt(lens.intrinsics_px[0, 0] * lens.intrinsics_px[1, 1]))
        border = _grid(height, width, 129)
        edge = (border == 0) | (border == [width - 1, height - 1])
        border = border[edge.any(axis=1)]
        for zoom in np.arange(1.0, MAX_ZOOM, 0.01):
            intrinsics = np.array([
                [zoom * focal, 0, (width - 1) / 2], [0, zoom * focal, (height - 1) / 2], [0, 0, 1]
            ])  # fmt: skip
            seen = lens.project(_rays(intrinsics, border))
            if ((seen >= 0) & (seen <= [width - 1, height - 1])).all():
                return cls(lens=lens, intrinsics_px=intrinsics)
        raise InputError(
            f"A lens {lens.model} with {lens.coefficients} cannot be remapped to a pinhole: "
            f"filling the image needs more than {MAX_ZOOM:g} times its focal length. Check its "
            "coefficients."
        )

    def apply(
        self, images: Iterable[UInt8[np.ndarray, "h w 3"]]
    ) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Yield images remapped with bilinear interpolation."""
        import cv2

        height, width = self.lens.height, self.lens.width
        rays = pixel_rays(self.intrinsics_px, height=height, width=width)
        x, y = np.moveaxis(self.lens.project(rays).astype(np.float32), -1, 0)
        for image in images:
            if image.shape != (height, width, 3):
                raise InputError(
                    f"An image has {image.shape[1]}x{image.shape[0]} pixels: its camera is "
                    f"calibrated for {width}x{height}."
                )
            yield cv2.remap(image, x, y, cv2.INTER_LINEAR)

    def move(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Map pixels of the lens's image to the pinhole's image; NaN outside the lens."""
        rays = self.lens.unproject(pixels)
        return rays * self.intrinsics_px[[0, 1], [0, 1]] + self.intrinsics_px[:2, 2]


def _rays(intrinsics: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    x = (pixels - intrinsics[:2, 2]) / intrinsics[[0, 1], [0, 1]]
    return np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)


def _grid(height: int, width: int, count: int) -> np.ndarray:
    rows, columns = np.linspace(0, height - 1, count), np.linspace(0, width - 1, count)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _brown(x: np.ndarray, y: np.ndarray, k: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
    )


def _fisheye(x: np.ndarray, y: np.ndarray, k: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    radial, rest = (k[:6], k[6:]) if len(k) == 12 else (k, ())
    r = np.hypot(x, y)
    theta = np.arctan(r)
    bent = theta * (1 + sum(c * theta ** (2 * n) for n, c in enumerate(radial, start=1)))
    scale = np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1.0)
    x, y = x * scale, y * scale
    if not rest:
        return x, y
    p0, p1, s0, s1, s2, s3 = rest
    r2 = x * x + y * y
    return (
        x + 2 * x * (p0 * x + p1 * y) + p0 * r2 + r2 * (s0 + s1 * r2),
        y + 2 * y * (p0 * x + p1 * y) + p1 * r2 + r2 * (s2 + s3 * r2),
    )
