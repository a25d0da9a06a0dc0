"""Pickled arrays are read as pickle reads them, and nothing in the file is ever run."""

import collections
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.io.digest import sha256
from egosim_jax.io.untrusted.pickled_arrays import read_pickled_arrays
from egosim_jax.types import InputError


class Calls:
    """Pickles as a call of anything."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


class Stated:
    """Pickles as an array whose state is given."""

    def __init__(self, *state):
        self.state = state

    def __reduce__(self):
        return np._core.multiarray._reconstruct, (np.ndarray, (0,), b"b"), self.state


def read(path: Path, data: bytes):
    path.write_bytes(data)
    return read_pickled_arrays(path, sha256=sha256(path))


@pytest.mark.parametrize("protocol", [2, 3, 4])
@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "i4", "u1", "?"])
def test_every_array_keeps_its_bits(tmp_path, dtype, protocol):
    values = np.arange(24).reshape(2, 3, 4).astype(dtype)
    tree = {"a": {"b": values}, "c": [values[0].T, np.array(3, dtype)], "rate": 0.1, "n": "text"}
    if protocol == 2:  # which has no bytes: NumPy's arrays are calls of an encoder there
        with pytest.raises(InputError, match=r"_codecs\.encode"):
            read(tmp_path / "a", pickle.dumps(tree, protocol))
        return
    found = read(tmp_path / "a", pickle.dumps(tree, protocol))
    expected = {"a.b": values, "c.0": values[0].T, "c.1": np.array(3, dtype)}
    assert list(found) == list(expected)
    for name, array in found.items():
        np.testing.assert_array_equal(array, expected[name], strict=True)
        assert not array.flags.writeable


def touch(path):
    Path(path).write_text("run", encoding="utf-8")


F4 = np.dtype("f4")
FORGED = {
    "a call of the system": (lambda mark: Calls(os.system, f"touch {mark}"), "system"),
    "a call of eval": (lambda mark: Calls(eval, f"open({str(mark)!r}, 'w')"), "eval"),
    "a function of the tests": (lambda mark: Calls(touch, str(mark)), "touch"),
    "an object with a state": (lambda mark: collections.Counter("a"), "Counter"),
    "a function of NumPy": (lambda mark: Calls(np.fromfile, "/etc/passwd"), "fromfile"),
    "a memory map": (lambda mark: Calls(np.memmap, "/etc/passwd"), "memmap"),
    "an array of objects": (lambda mark: np.array([{1}], object), "'O8'"),
    "text": (lambda mark: np.array(["a"]), "'U1'"),
    "big-endian numbers": (lambda mark: np.arange(3, dtype=">f4"), "unsupported state"),
    "a structure": (lambda mark: np.zeros(2, "f4,i4"), "'V8'"),
    "a call of a class": (lambda mark: Calls(np.ndarray, (10**9,)), "unsupported arguments"),
    "more values than bytes": (lambda mark: Stated(1, (9,), F4, False, b"1234"), "has 4 bytes"),
    "a negative size": (lambda mark: Stated(1, (-1,), F4, False, b""), "has -1 where a size"),
    "too many axes": (lambda mark: Stated(1, (1,) * 40, F4, False, b"1234"), "40 axes"),
    "a size beyond memory": (lambda mark: Stated(1, (1 << 47,) * 2, F4, False, b""), "more than"),
    "a list of values": (lambda mark: Stated(1, (1,), F4, False, [1.0]), "a list of 1"),
    "a state of text": (lambda mark: Stated("x"), "unsupported state"),
    "no state": (lambda mark: Calls(np._core.multiarray._reconstruct, np.ndarray, (0,), b"b"),
                 "no values"),
    "a dtype by itself": (lambda mark: F4, "not a tensor"),
}  # fmt: skip


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_pickle_is_refused_with_the_reason_and_not_run(tmp_path, name):
    make, reason = FORGED[name]
    mark = tmp_path / "mark"
    with pytest.raises(InputError) as error:
        read(tmp_path / "a", pickle.dumps({"first": make(mark)}, 3))
    assert reason in str(error.value)
    assert not mark.exists()


def test_a_file_of_another_hash_is_refused(tmp_path):
    (tmp_path / "a").write_bytes(pickle.dumps({"a": np.arange(3.0)}, 3))
    with pytest.raises(InputError, match="its SHA-256 is"):
        read_pickled_arrays(tmp_path / "a", sha256="0" * 64)
