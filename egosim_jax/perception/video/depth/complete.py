"""Completion of sparse inverse depth by image-guided diffusion.

The completed map d minimizes

    sum_i c_i (d_i - m_i)^2 + lambda sum_(i,j) w_ij (d_i - d_j)^2,   w_ij = exp(-|I_i - I_j|/sigma)

over measured pixels i with confidence c and neighboring pixels (i, j), with colors I in CIE Lab.
The minimum is the solution of a sparse symmetric linear system. Conjugate gradients find it,
starting from a coarser solution. Inverse depth is used because it is affine in the pixel
coordinates on any plane of the scene. Source: Levin, Lischinski, Weiss 2004, who complete colors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from egosim_jax.types.arrays import RgbImage


@dataclass(frozen=True, kw_only=True)
class Diffusion:
    """Parameters of the completion."""

    smoothness: float = 0.3
    """Weight lambda of the smoothness; a measurement of confidence 1 has weight 1."""
    sigma: float = 0.03
    """Lab color difference at which smoothness falls to 1/e, in units of the range of L."""
    floor: float = 1e-4
    """Minimum weight between neighbors; above 0, so every pixel gets a value."""
    tolerance: float = 1e-5
    """Relative residual at which conjugate gradients stop."""
    max_iterations: int = 400
    """Maximum number of iterations on each level."""

    def __call__(
        self,
        image: RgbImage,
        measured: Float[np.ndarray, "h w"],
        confidence: Float[np.ndarray, "h w"],
    ) -> Float32[np.ndarray, "h w"]:
        """Return the completed map. `measured` is ignored where the confidence is 0."""
        import cv2

        height, width = measured.shape
        start = np.full((height, width), np.average(measured, weights=confidence))
        if min(height, width) >= 32:
            small = (width // 2, height // 2)
            weight = cv2.resize(confidence, small, interpolation=cv2.INTER_AREA)
            mean = cv2.resize(measured * confidence, small, interpolation=cv2.INTER_AREA)
            mean = np.where(weight > 0, mean / np.maximum(weight, 1e-12), 0)
            colors = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
            coarse = self(colors, mean, 4 * weight)
            start = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
        return self._solve(image, measured, confidence, start)

    def _solve(
        self,
        image: RgbImage,
        measured: Float[np.ndarray, "h w"],
        confidence: Float[np.ndarray, "h w"],
        start: Float[np.ndarray, "h w"],
    ) -> Float32[np.ndarray, "h w"]:
        from scipy.sparse import diags_array
        from scipy.sparse.linalg import cg

        across, down = self._weights(image)
        height, width = measured.shape
        right = np.pad(across, ((0, 0), (0, 1))).ravel()
        below = np.pad(down, ((0, 1), (0, 0))).ravel()
        total = right + below + np.roll(right, 1) + np.roll(below, width)
        diagonal = confidence.ravel() + total
        matrix = diags_array(
            [diagonal, -right[:-1], -right[:-1], -below[:-width], -below[:-width]],
            offsets=np.array([0, 1, -1, width, -width]),  # pyright: ignore[reportArgumentType]
        ).tocsr()
        weighted = np.where(confidence > 0, confidence * measured, 0).ravel()
        solved, _ = cg(
            matrix,
            weighted,
            x0=start.ravel().astype(float),
            rtol=self.tolerance,
            maxiter=self.max_iterations,
            M=diags_array(1 / diagonal),
        )
        return solved.reshape(height, width).astype(np.float32)

    def _weights(
        self, image: RgbImage
    ) -> tuple[Float[np.ndarray, "h w-1"], Float[np.ndarray, "h-1 w"]]:
        """Return lambda w_ij between each pixel and its neighbors to the right and below."""
        import cv2

        lab = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB) / 100
        return tuple(
            self.smoothness
            * np.maximum(
                np.exp(-np.linalg.norm(np.diff(lab, axis=axis), axis=-1) / self.sigma), self.floor
            )
            for axis in (1, 0)
        )
