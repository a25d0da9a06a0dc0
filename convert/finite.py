"""Checks that weights are finite numbers, also after a cast to a dtype of smaller range."""

from __future__ import annotations

import ml_dtypes
import numpy as np

from egosim_jax.types import InputError

CHUNK = 1 << 20
"""Number of values that are checked at a time."""


def is_floating(dtype: np.dtype) -> bool:
    """Return True for NumPy's floating dtypes, bfloat16 and float8."""
    return np.issubdtype(dtype, np.floating) or dtype.name.startswith(("bfloat", "float8"))


def all_finite(array: np.ndarray) -> bool:
    """Return True if no value is NaN or infinite.

    The bits are compared, because `isfinite` takes five times as long for half precision.
    """
    if not is_floating(array.dtype):
        return True
    bits = np.dtype(f"u{array.dtype.itemsize}")
    sign = bits.type(1) << bits.type(8 * bits.itemsize - 1)
    limit = np.array(ml_dtypes.finfo(array.dtype).max, array.dtype).view(bits)
    flat = np.ascontiguousarray(array).reshape(-1).view(bits)
    return all(
        (flat[start : start + CHUNK] & ~sign).max() <= limit for start in range(0, flat.size, CHUNK)
    )


def out_of_range(array: np.ndarray, dtype: np.dtype, *, name: str, fix: str) -> InputError:
    """Return the error of an array whose values are not all finite in a dtype.

    `fix` says what to do if the dtype's range is too small for finite values.
    """
    values = array.astype(np.float64)
    if bad := int((~np.isfinite(values)).sum()):
        return InputError(
            f"{name} has {bad:,} of {values.size:,} values that are not finite, and weights must "
            "be: the training diverged, or the file is damaged. Take an earlier checkpoint, or "
            "download the file again."
        )
    highest, limit = np.abs(values).max(), float(ml_dtypes.finfo(dtype).max)
    return InputError(f"{name} has values up to {highest:.4g}; {dtype} ends at {limit:.4g}. {fix}")
