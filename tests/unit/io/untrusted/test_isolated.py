"""A file that makes its library hang or crash is refused, and the next one is read."""

import os
import signal
import time

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from egosim_jax.io.untrusted import isolated
from egosim_jax.io.untrusted.isolated import read_hdf5, read_parquet
from egosim_jax.types import InputError


@pytest.fixture
def path(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = np.arange(6, dtype=np.int16).reshape(2, 3)
        file["y"] = np.float32([0.5])
        file.attrs["names"] = ["a", "ü"]
        file.attrs["one"] = "text"
    return tmp_path / "a.h5"


def test_arrays_and_texts_come_back_as_they_are(path):
    found = read_hdf5(
        path, {"x": (None, 3)}, optional={"y": (1,), "z": (1,)}, texts=["names", "one", "none"]
    )
    np.testing.assert_array_equal(found.arrays["x"], [[0, 1, 2], [3, 4, 5]])
    assert found.arrays["y"].tolist() == [0.5]
    assert found.arrays.keys() == {"x", "y"}
    assert found.texts == {"names": ("a", "ü"), "one": ("text",), "none": ()}


def test_columns_come_back_as_they_are(tmp_path):
    table = {"a": [1, 2], "b": [["x"], []], "c": [0.5, None]}
    pq.write_table(pa.table(table), tmp_path / "a.parquet")
    assert read_parquet(tmp_path / "a.parquet", ["a", "b"], optional=["c", "d"]) == table


def test_an_error_names_the_file_and_the_child_lives_on(path):
    with pytest.raises(InputError, match=r"a\.h5: x has shape"):
        read_hdf5(path, {"x": (4, 4)})
    process = isolated._CHILD._process
    read_hdf5(path, {"y": (1,)})
    assert isolated._CHILD._process is process


def test_a_crash_is_reported_and_the_next_file_is_read(path):
    read_hdf5(path, {"y": (1,)})
    os.kill(isolated._CHILD._process.pid, signal.SIGSTOP)
    os.kill(isolated._CHILD._process.pid, signal.SIGKILL)
    isolated._CHILD._process.poll = lambda: None  # as if it ended while it reads
    with pytest.raises(InputError, match="crash"):
        read_hdf5(path, {"y": (1,)})
    assert read_hdf5(path, {"y": (1,)}).arrays["y"].tolist() == [0.5]


def test_a_hang_is_ended_after_the_time_limit(path, monkeypatch):
    read_hdf5(path, {"y": (1,)})
    os.kill(isolated._CHILD._process.pid, signal.SIGSTOP)
    monkeypatch.setattr(isolated, "TIMEOUT_S", 0.2)
    then = time.monotonic()
    with pytest.raises(InputError, match="hangs on it"):
        read_hdf5(path, {"y": (1,)})
    assert time.monotonic() - then < 5
    monkeypatch.undo()
    assert read_hdf5(path, {"y": (1,)}).arrays["y"].tolist() == [0.5]
