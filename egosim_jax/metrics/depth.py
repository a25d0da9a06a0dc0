"""How far off depth is. The paper's Depth ERR comes without a formula; this definition is ours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32


def depth_error(
    depth_m: Float32[np.ndarray, "f h w"],
    truth_m: Float32[np.ndarray, "f h w"],
    counted: Bool[np.ndarray, "f h w"],
) -> float:
    """Mean of |depth - truth| / truth in percent, over the counted pixels where both are known.

    NaN if there are none.
    """
    known = counted & np.isfinite(depth_m) & np.isfinite(truth_m) & (depth_m > 0) & (truth_m > 0)
    if not known.any():
        return float("nan")
    depth, truth = depth_m[known].astype(float), truth_m[known].astype(float)
    return float(100 * np.mean(np.abs(depth - truth) / truth))


def coverage(depth_m: Float32[np.ndarray, "f h w"], counted: Bool[np.ndarray, "f h w"]) -> float:
    """Share of the counted pixels whose depth is known, in percent; NaN if none count."""
    return float(100 * np.isfinite(depth_m[counted]).mean()) if counted.any() else float("nan")
