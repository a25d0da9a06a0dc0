"""Depth error. The paper gives no formula for its Depth ERR; this definition is ours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32


def depth_error(
    depth_m: Float32[np.ndarray, "f h w"],
    target_m: Float32[np.ndarray, "f h w"],
    counted: Bool[np.ndarray, "f h w"],
) -> float:
    """Return mean |depth - target| / target in percent over counted pixels where both are known.

    NaN without such pixels.
    """
    valid = counted & np.isfinite(depth_m) & np.isfinite(target_m) & (depth_m > 0) & (target_m > 0)
    if not valid.any():
        return float("nan")
    depth, target = depth_m[valid].astype(float), target_m[valid].astype(float)
    return float(100 * np.mean(np.abs(depth - target) / target))


def coverage(depth_m: Float32[np.ndarray, "f h w"], counted: Bool[np.ndarray, "f h w"]) -> float:
    """Return the percentage of counted pixels with known depth; NaN without counted pixels."""
    return float(100 * np.isfinite(depth_m[counted]).mean()) if counted.any() else float("nan")
