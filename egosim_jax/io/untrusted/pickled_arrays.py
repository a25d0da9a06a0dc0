"""Read pickles of NumPy arrays in plain containers without executing them."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.bounded import quote, quote_path, quote_text, read_bytes
from egosim_jax.io.mapped import MAX_AXES, RefusedError, check_sizes, digest, strides_of
from egosim_jax.io.untrusted.pickled import ACTIONS, Interpreter, Name, Opaque, flatten
from egosim_jax.types import InputError

DTYPES = {"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1"}
"""Codes of the dtypes that arrays may have."""
MAX_BYTES = 256 << 20
"""Maximum size of a pickle in bytes, including its arrays."""


def read_pickled_arrays(path: Path, *, sha256: str) -> dict[str, np.ndarray]:
    """Return the read-only arrays of a pickle by name, nested keys joined by dots.

    Raises `InputError` with the reason if the file has another SHA-256, is damaged, or holds
    objects other than arrays, plain values and containers.
    """
    data = read_bytes(path, limit=MAX_BYTES)
    try:
        if digest(data) != sha256:
            raise RefusedError(f"its SHA-256 is {digest(data)}, not {sha256}")
        found = flatten(NumPyInterpreter(data).run(), PickledArray)
        return {name: array.values() for name, array in found.items()}
    except (ValueError, struct.error) as error:
        reason = str(error) if isinstance(error, RefusedError) else quote_text(str(error))
        raise InputError(
            f"{quote_path(path)} cannot be read: {reason}. Only NumPy arrays in plain containers "
            "are supported. Install or copy the file again."
        ) from error


@dataclass
class _DType(Opaque):
    """Dtype; its state must confirm the byte order."""

    code: str


@dataclass
class PickledArray(Opaque):
    """NumPy array of a pickle, filled by its state."""

    filled: np.ndarray | None = None

    def values(self) -> np.ndarray:
        """Return the values. Raises `RefusedError` if no state has set them."""
        if self.filled is None:
            raise RefusedError("one of its arrays has no values")
        return self.filled


class NumPyInterpreter(Interpreter):
    """Pickle interpreter that adds NumPy's arrays, as written at protocols 2 to 4."""

    allowed = Interpreter.allowed | {
        "numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct",
        "numpy.ndarray", "numpy.dtype",
    }  # fmt: skip
    actions = ACTIONS | dict.fromkeys(("BINBYTES", "SHORT_BINBYTES", "BINBYTES8"), Interpreter.push)
    max_bytes = MAX_BYTES

    def called(self, name: str, arguments: tuple) -> Any:
        """Return an array or a dtype that has no state yet."""
        match (name, arguments):
            case (
                "numpy.core.multiarray._reconstruct" | "numpy._core.multiarray._reconstruct",
                (Name("numpy.ndarray"), (0,), b"b"),
            ):
                return PickledArray()
            case ("numpy.dtype", (str(code), bool(), bool())) if code in DTYPES:
                return _DType(code)
            case ("numpy.dtype", (code, *_)):
                raise RefusedError(f"its pickle has the unsupported dtype {quote(code)}")
            case _:
                return super().called(name, arguments)

    def set_state(self, target: Any, state: Any) -> None:
        """Fill an array, or confirm the byte order of a dtype."""
        match (target, state):
            case (_DType(), (int(), "<" | "|", None, None, None, int(), int(), int())):
                pass
            case (
                PickledArray(filled=None),
                (int(), tuple(shape), _DType(code), bool(by_column), data),
            ):
                target.filled = _filled(shape, np.dtype(f"<{code}"), by_column, data)
            case (_DType(), _) | (PickledArray(), _):
                raise RefusedError("one of its arrays has an unsupported state")
            case _:
                super().set_state(target, state)


def _filled(shape: tuple, dtype: np.dtype, by_column: bool, data: Any) -> np.ndarray:
    """Return the bytes as an array. Raises `RefusedError` if their number does not fit."""
    if len(shape) > MAX_AXES:
        raise RefusedError(f"an array has {len(shape)} axes; the limit is {MAX_AXES}")
    check_sizes("an array", shape)
    strides_of("an array", shape, dtype)
    if not isinstance(data, bytes) or len(data) != math.prod(shape) * dtype.itemsize:
        raise RefusedError(f"an array of shape {shape} and dtype {dtype} has {quote(data)}")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if by_column else "C")
