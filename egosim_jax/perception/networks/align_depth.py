"""Alignment of a network's depth with the scene's depth at static pixels.

The error of monocular networks is mostly a scale and a shift of inverse depth, different in each
frame: 1 / aligned = scale / depth + shift. RANSAC (Fischler and Bolles, 1981) fits both to pairs of
pixels and refits them to the inliers. Source of the model: Ranftl et al., Towards Robust Monocular
Depth Estimation, 2020, section 5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from egosim_jax.types import InputError, check_counts
from egosim_jax.types.arrays import Mask

MAX_COMPARED = 5000
"""Approximate maximum number of pixels compared in a trial."""


@dataclass(frozen=True, kw_only=True)
class DepthAlignment:
    """Parameters of the alignment of one depth map with another."""

    min_pixels: int = 200
    """Minimum number of compared pixels; with fewer, depth is unknown."""
    tolerance: float = 0.05
    """Maximum relative difference of inverse depth at a pixel that agrees."""
    min_agreement: float = 0.5
    """Minimum fraction of compared pixels that agree; below it, depth is unknown."""
    trials: int = 200
    """Number of pixel pairs to try."""

    def __post_init__(self) -> None:
        """Check that numbers are positive and fractions at most 1."""
        check_counts({"min_pixels": self.min_pixels, "trials": self.trials})
        if not (self.tolerance > 0 and 0 <= self.min_agreement <= 1):
            raise InputError(
                f"tolerance {self.tolerance} must be positive, and min_agreement "
                f"{self.min_agreement} from 0 to 1."
            )

    def __call__(
        self, depth_m: Float32[np.ndarray, "h w"], scene_m: Float32[np.ndarray, "h w"], static: Mask
    ) -> Float32[np.ndarray, "h w"]:
        """Return a depth map aligned with the scene's at static pixels.

        The whole map is infinite if too few pixels can be compared or agree, because unknown depth
        does less harm than wrong depth.
        """
        unknown = np.full_like(depth_m, np.inf)
        compared = static & np.isfinite(scene_m) & np.isfinite(depth_m) & (depth_m > 0)
        if compared.sum() < self.min_pixels:
            return unknown
        every = max(1, int(compared.sum()) // MAX_COMPARED)
        here = 1.0 / depth_m[compared][::every].astype(float)
        there = 1.0 / scene_m[compared][::every].astype(float)
        scale, shift, agreement = self._fit(here, there)
        if agreement < self.min_agreement:
            return unknown
        with np.errstate(divide="ignore"):
            inverse = scale / depth_m.astype(float) + shift
            return np.where(inverse > 0, 1 / inverse, np.inf).astype(np.float32)

    def _fit(self, here: np.ndarray, there: np.ndarray) -> tuple[float, float, float]:
        """Return scale, shift, and the fraction of inverse depths that agree with them."""
        pairs = np.random.default_rng(0).integers(0, len(here), (2, self.trials))
        run = here[pairs[1]] - here[pairs[0]]
        usable = np.abs(run) > 1e-3 * here[pairs[0]]
        scales = (there[pairs[1]] - there[pairs[0]])[usable] / run[usable]
        shifts = there[pairs[0]][usable] - scales * here[pairs[0]][usable]
        # Also try a scale alone: a plane at constant depth does not determine a shift.
        scales = np.append(scales, np.median(there / here))
        shifts = np.append(shifts, 0.0)
        shares = [
            self._agree(scale, shift, here, there).mean() if scale > 0 else 0.0
            for scale, shift in zip(scales, shifts, strict=True)
        ]
        best = int(np.argmax(shares))
        scale, shift, share = float(scales[best]), float(shifts[best]), float(shares[best])
        agree = self._agree(scale, shift, here, there)
        if agree.sum() > 2 and np.ptp(here[agree]) > 1e-3 * here.mean():
            design = np.stack([here, np.ones_like(here)], axis=1)[agree] / there[agree, None]
            a, b = np.linalg.lstsq(design, np.ones(agree.sum()), rcond=None)[0].tolist()
            again = float(self._agree(a, b, here, there).mean())
            if a > 0 and again >= share:
                return a, b, again
        return scale, shift, share

    def _agree(
        self, scale: float, shift: float, here: np.ndarray, there: np.ndarray
    ) -> Bool[np.ndarray, " n"]:
        return np.abs((scale * here + shift) / there - 1) <= self.tolerance
