"""Read pickles of NumPy arrays without executing them: in plain containers, or MANO hand models.

Python 2 wrote MANO's models at protocol 2, so arrays are built from its byte strings. They hold
three kinds of objects, each built from a state of plain values, without chumpy and scipy:

    chumpy.ch.Ch                 an array, `x`
    chumpy.reordering.Select     entries `idxs` of the flattened `a`, in the shape `preferred_shape`
    scipy.sparse.csc.csc_matrix  `data`, `indices` and `indptr` of compressed columns

Other objects are refused, and so are globals that would run code. Files that a later Python saved
again, also with plain arrays, are read as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from egosim_jax.io.bounded import quote, quote_text, read_bytes
from egosim_jax.io.mapped import MAX_AXES, RefusedError, check_sizes, digest, strides_of
from egosim_jax.io.untrusted.pickled import (
    ACTIONS,
    Interpreter,
    Name,
    Opaque,
    flatten,
    refusing_damage,
)

DTYPES = {"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1"}
"""Codes of the dtypes that arrays may have."""
MAX_BYTES = 256 << 20
"""Maximum size of a pickle in bytes, including its arrays."""
ARRAY, SELECT = "chumpy.ch.Ch", "chumpy.reordering.Select"
SPARSE = frozenset({"scipy.sparse.csc.csc_matrix", "scipy.sparse._csc.csc_matrix"})
NEW = frozenset({"copy_reg._reconstructor", "copyreg._reconstructor"})
OBJECT = frozenset({"__builtin__.object", "builtins.object"})
SETS = frozenset({"__builtin__.set", "builtins.set"})
MAX_DENSE = 1 << 24
"""Maximum number of entries in a dense matrix made from a sparse one."""


def read_pickled_arrays(path: Path, *, sha256: str) -> dict[str, np.ndarray]:
    """Return the read-only arrays of a pickle by name, nested keys joined by dots.

    Raises `InputError` with the reason if the file has another SHA-256, is damaged, or holds
    objects other than arrays, plain values and containers.
    """
    data = read_bytes(path, limit=MAX_BYTES)
    fix = "Only NumPy arrays in plain containers are supported. Install or copy the file again."
    with refusing_damage(path, fix):
        if digest(data) != sha256:
            raise RefusedError(f"its SHA-256 is {digest(data)}, not {sha256}")
        arrays = flatten(_NumPy(data).run(), _Array)
        return {name: array.values() for name, array in arrays.items()}


def read_model(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a hand model by name; other values are ignored.

    Raises `InputError` with the reason if the file is damaged or asks for code.
    """
    data = read_bytes(path, limit=MAX_BYTES)
    fix = (
        "Only the arrays of a hand model are supported, as in MANO_RIGHT.pkl and MANO_LEFT.pkl of "
        "mano.is.tue.mpg.de; download the file again. (--mano-right, --mano-left)"
    )
    with refusing_damage(path, fix):
        root = _Model(data).run()
        if not isinstance(root, dict):
            raise RefusedError(f"it holds {quote(root)}, not a dictionary")
        arrays = {str(name): _dense(value) for name, value in root.items()}
        return {name: array for name, array in arrays.items() if array is not None}


@dataclass
class _DType(Opaque):
    """Dtype; its state must confirm the byte order."""

    code: str


@dataclass
class _Array(Opaque):
    """NumPy array of a pickle, filled by its state."""

    filled: np.ndarray | None = None

    def values(self) -> np.ndarray:
        """Return the values. Raises `RefusedError` if no state has set them."""
        if self.filled is None:
            raise RefusedError("one of its arrays has no values")
        return self.filled


class _NumPy(Interpreter):
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
                return _Array()
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
                _Array(filled=None),
                (int(), tuple(shape), _DType(code), bool(by_column), data),
            ):
                target.filled = _filled(shape, np.dtype(f"<{code}"), by_column, data)
            case (_DType(), _) | (_Array(), _):
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


@dataclass
class _Object(Opaque):
    """Object of one of the three classes; its state is set later."""

    kind: str
    state: dict[str, Any] | None = None


class _Model(_NumPy):
    """Interpreter that adds Python 2's strings, chumpy's arrays and sparse matrices."""

    allowed = _NumPy.allowed | {ARRAY, SELECT} | SPARSE | NEW | OBJECT | SETS
    actions: ClassVar = {
        **_NumPy.actions,
        "SHORT_BINSTRING": _NumPy.push,
        "BINSTRING": _NumPy.push,
        "NEWOBJ": _NumPy._call,
    }

    def called(self, name: str, arguments: tuple) -> Any:
        """Return an object without its state, or NumPy's array or dtype."""
        classes = {ARRAY, SELECT} | SPARSE
        match arguments:
            case () if name in classes:
                return _Object(name)
            case (Name(kind), Name(base), None) if name in NEW and base in OBJECT:
                if kind in classes:
                    return _Object(kind)
            case (list(items),) if name in SETS:
                return items
            case (Name("numpy.ndarray"), (0,), "b"):
                return super().called(name, (Name("numpy.ndarray"), (0,), b"b"))
            case (str(code), int(align), int(copy)) if name == "numpy.dtype":
                return super().called(name, (code, bool(align), bool(copy)))
        return super().called(name, arguments)

    def set_state(self, target: Any, state: Any) -> None:
        """Set the state of an object, or of an array whose bytes Python 2 wrote as a string."""
        match (target, state):
            case (_Object(state=None), dict()):
                target.state = state
            case (_Array(), (version, shape, dtype, by_column, str(data))):
                by_column = bool(by_column) if type(by_column) is int else by_column
                encoded = data.encode("latin-1")
                super().set_state(target, (version, shape, dtype, by_column, encoded))
            case _:
                super().set_state(target, state)


def _dense(value: Any) -> np.ndarray | None:
    """Return a value as an array, or None."""
    match value:
        case _Array():
            return value.values()
        case _Object(kind=kind, state=dict(state)):
            if kind == ARRAY:
                return _required(state, "x")
            if kind == SELECT:
                indices, shape = _required(state, "idxs"), state["preferred_shape"]
                return _required(state, "a").reshape(-1)[indices].reshape(shape)
            return _from_columns(state)
        case _Object():
            raise RefusedError("one of its objects has no state")
    return None


def _required(state: dict[str, Any], name: str) -> np.ndarray:
    array = _dense(state.get(name))
    if array is None:
        raise RefusedError(f"one of its objects has no array {name}")
    return array


def _from_columns(state: dict[str, Any]) -> np.ndarray:
    """Return the dense matrix of compressed columns."""
    values, rows, starts = (_required(state, name) for name in ("data", "indices", "indptr"))
    match state.get("_shape"):
        case (int(height), int(width)) if min(height, width) >= 1 and height * width <= MAX_DENSE:
            shape = height, width
        case other:
            raise RefusedError(f"a sparse matrix has the shape {quote_text(str(other))}")
    counts = np.diff(starts)
    if len(starts) != shape[1] + 1 or starts[0] != 0 or (counts < 0).any():
        raise RefusedError("a sparse matrix has invalid columns")
    if len(rows) != len(values) or starts[-1] != len(values):
        raise RefusedError("a sparse matrix has other numbers of rows and values")
    if len(rows) and not 0 <= rows.min() <= rows.max() < shape[0]:
        raise RefusedError("a sparse matrix has rows outside of it")
    dense = np.zeros(shape)
    np.add.at(dense, (rows, np.repeat(np.arange(shape[1]), counts)), values)
    return dense
