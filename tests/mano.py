"""Pickles of random hand models in the layout of MANO's files, as Python 2 wrote them."""

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

VERTICES, JOINTS = 30, 16
PARENTS = [0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]


class Global:
    """Reference to a global by module and name."""

    def __init__(self, module: str, name: str):
        self.module, self.name = module, name


class Made:
    """Object of a new-style class with a dictionary as its state."""

    def __init__(self, module: str, name: str, state: dict[str, Any]):
        self.kind, self.state = Global(module, name), state


class Called:
    """Result of a call, as `reduce` writes it."""

    def __init__(self, function: Global, arguments: Sequence[Any]):
        self.function, self.arguments = function, tuple(arguments)


def dump(value: Any) -> bytes:
    """Return a pickle of protocol 2 with the strings of Python 2."""
    return b"\x80\x02" + _write(value) + b"."


def _write(value: Any) -> bytes:
    match value:
        case None:
            return b"N"
        case bool():
            return b"\x88" if value else b"\x89"
        case int():
            return b"J" + struct.pack("<i", value)
        case str() | bytes():
            data = value.encode("latin-1") if isinstance(value, str) else value
            if len(data) < 256:
                return b"U" + bytes([len(data)]) + data
            return b"T" + struct.pack("<i", len(data)) + data
        case tuple():
            return b"(" + b"".join(map(_write, value)) + b"t"
        case list():
            return b"](" + b"".join(map(_write, value)) + b"e"
        case dict():
            return b"}(" + b"".join(_write(x) for pair in value.items() for x in pair) + b"u"
        case Global():
            return f"c{value.module}\n{value.name}\n".encode()
        case Called():
            return _write(value.function) + _write(value.arguments) + b"R"
        case Made():
            return _write(value.kind) + b")\x81" + _write(value.state) + b"b"
        case np.ndarray():
            return _array(value)
    raise TypeError(type(value))


def _array(array: np.ndarray) -> bytes:
    multiarray = Global("numpy.core.multiarray", "_reconstruct")
    empty = Called(multiarray, (Global("numpy", "ndarray"), (0,), "b"))
    code = array.dtype.str[1:]
    dtype = _write(Called(Global("numpy", "dtype"), (code, 0, 1)))
    dtype += _write((3, "<", None, None, None, -1, -1, 0)) + b"b"
    state = b"(" + _write(1) + _write(array.shape) + dtype + _write(False)
    return _write(empty) + state + _write(array.tobytes()) + b"tb"


def random_model(seed: int = 0) -> dict[str, np.ndarray]:
    """Return the arrays of a random hand of few vertices."""
    rng = np.random.default_rng(seed)
    regressor = rng.uniform(size=(JOINTS, VERTICES)) * (rng.uniform(size=(JOINTS, VERTICES)) < 0.3)
    regressor[:, 0] += 0.1
    weights = rng.uniform(size=(VERTICES, JOINTS)) ** 4
    return {
        "v_template": rng.normal(scale=0.05, size=(VERTICES, 3)),
        "shapedirs": rng.normal(scale=0.01, size=(VERTICES, 3, 10)),
        "posedirs": rng.normal(scale=0.01, size=(VERTICES, 3, 135)),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, *PARENTS], range(16)], np.uint32),
        "f": rng.integers(0, VERTICES, (40, 3)).astype(np.uint32),
        "hands_mean": rng.normal(scale=0.3, size=45),
    }


def model_pickle(arrays: dict[str, np.ndarray], **changes: Any) -> bytes:
    """Return the pickle of a model with the objects of chumpy and scipy that MANO's files have."""
    shapedirs = arrays["shapedirs"]
    padded = np.concatenate([shapedirs, np.zeros_like(shapedirs)], axis=-1)
    indices = np.arange(padded.size).reshape(padded.shape)[..., : shapedirs.shape[-1]]
    dirty = Called(Global("__builtin__", "set"), [["x"]])
    inner = Made("chumpy.ch", "Ch", {"x": padded, "_dirty_vars": dirty})
    select = {"a": inner, "idxs": indices.ravel(), "preferred_shape": shapedirs.shape}
    dense = arrays["J_regressor"]
    columns, rows = np.nonzero(dense.T)
    starts = np.concatenate([[0], np.cumsum(np.bincount(columns, minlength=dense.shape[1]))])
    sparse = {
        "_shape": dense.shape, "maxprint": 50, "data": dense[rows, columns],
        "indices": rows.astype(np.int32), "indptr": starts.astype(np.int32),
    }  # fmt: skip
    model: dict[str, Any] = {
        **arrays,
        "bs_type": "lrotmin",
        "v_template": Made("chumpy.ch", "Ch", {"x": arrays["v_template"]}),
        "shapedirs": Made("chumpy.reordering", "Select", select),
        "J_regressor": Made("scipy.sparse.csc", "csc_matrix", sparse),
        **changes,
    }
    return dump(model)
