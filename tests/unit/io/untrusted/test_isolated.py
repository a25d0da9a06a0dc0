"""A file that makes its library hang or crash is refused, and the next one is read."""

import os
import re
import signal
import subprocess
import sys
import time
import zlib
from decimal import Decimal
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from egosim_jax.io.untrusted import isolated
from egosim_jax.io.untrusted.hdf5 import read_hdf5
from egosim_jax.io.untrusted.parquet import read_parquet
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


KINDS = {
    "timestamp[ns]": np.zeros(1 << 20, "M8[ns]"),
    "list<element: date32[day]>": pa.array([[0]], pa.list_(pa.date32())),
    "decimal128(3, 1)": pa.DictionaryArray.from_arrays(
        pa.array([0], pa.int32()), pa.array([Decimal("10.5")])
    ),
    "struct<b: int64>": pa.array([{"b": 1}]),
    "binary": pa.array([b"x"]),
}


@pytest.mark.parametrize("kind", KINDS)
def test_values_that_are_slow_in_python_are_refused(tmp_path, kind):
    pq.write_table(pa.table({"a": KINDS[kind], "b": KINDS[kind]}), tmp_path / "a.parquet")
    with pytest.raises(InputError) as caught:
        read_parquet(tmp_path / "a.parquet", [], optional=["b"])
    assert str(caught.value).startswith(
        f"Column b of {tmp_path}/a.parquet has values of type {kind}: numbers, texts and lists "
    )


def test_nested_and_packed_numbers_are_read(tmp_path):
    grid = pa.array([[[1.5, 2], [3, 4]]], pa.list_(pa.list_(pa.float32(), 2)))
    name = pa.array(["left"]).dictionary_encode()
    pq.write_table(pa.table({"a": grid, "b": name, "c": pa.nulls(1)}), tmp_path / "a.parquet")
    columns = read_parquet(tmp_path / "a.parquet", ["a", "b", "c"])
    assert columns == {"a": [[[1.5, 2], [3, 4]]], "b": ["left"], "c": [None]}


def _pid(path):
    return os.getpid()


def _crash(path):
    os.kill(os.getpid(), signal.SIGKILL)


def _sleep(path):
    time.sleep(600)


def _busy(path):
    while True:
        pass


def test_an_error_names_the_file_and_the_child_lives_on(path):
    child = isolated.read_file(_pid, path)
    with pytest.raises(InputError, match=r"a\.h5: x has shape"):
        read_hdf5(path, {"x": (4, 4)})
    assert isolated.read_file(_pid, path) == child != os.getpid()


@pytest.mark.parametrize(
    ("read", "message"),
    [(_crash, "crash"), (_sleep, r"within 0\.5 s: "), (_busy, r"within 0\.5 s of processor time")],
)
def test_a_crash_or_a_hang_is_reported_and_the_next_file_is_read(path, monkeypatch, read, message):
    isolated.read_file(_pid, path)
    monkeypatch.setattr(isolated, "TIMEOUT_S", 5.0 if read is _busy else 0.5)
    then = time.monotonic()
    with pytest.raises(InputError, match=message):
        isolated.read_file(read, path, max_cpu_s=0.5)
    assert time.monotonic() - then < 5
    monkeypatch.undo()
    assert read_hdf5(path, {"y": (1,)}).arrays["y"].tolist() == [0.5]


def test_many_arrays_of_one_value_are_refused_before_they_are_read(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "xyz":
            file.create_dataset(name, (1 << 19, 4, 4), "f4", chunks=(1 << 12, 4, 4), fillvalue=1)
    assert (tmp_path / "a.h5").stat().st_size < 20_000
    shape = (None, 4, 4)
    with pytest.raises(InputError, match="up to z have 201,326,592 bytes, more than 134,217,728"):
        read_hdf5(tmp_path / "a.h5", {"x": shape, "y": shape}, optional={"z": shape})


def test_many_equal_rows_are_refused_before_they_are_read(tmp_path):
    pq.write_table(pa.table({"a": np.full((1 << 23) + 1, 7)}), tmp_path / "a.parquet")
    assert (tmp_path / "a.parquet").stat().st_size < 50_000
    with pytest.raises(InputError, match="declares 8,388,609 values"):
        read_parquet(tmp_path / "a.parquet", ["a"])


def chunk(path):
    """A dataset of 72 bytes in a chunk of 512 MiB."""
    with h5py.File(path, "w") as file:
        options = {"chunks": (1 << 13, 1 << 13), "maxshape": (None, None), "compression": "gzip"}
        file.create_dataset("x", (3, 3), "f8", **options)


def deflated(path):
    """A chunk of 2 KiB whose stream unpacks to 700 MiB."""
    with h5py.File(path, "w") as file:
        data = file.create_dataset("x", (16, 16), "f8", chunks=(16, 16), compression="gzip")
        packer, packed = zlib.compressobj(9), b""
        for _ in range(700):
            packed += packer.compress(bytes(1 << 20))
        data.id.write_direct_chunk((0, 0), packed + packer.flush())


def dictionary(path):
    rows = pa.DictionaryArray.from_arrays(np.zeros(1 << 20, np.int32), ["x" * (1 << 20)])
    pq.write_table(pa.table({"x": rows}), path)


def runs(path):
    """Lists of texts, all equal."""
    rows = pa.array([["x" * 99] * 8] * 1_000_000)
    pq.write_table(pa.table({"x": rows}), path)


def prefixes(path):
    texts = ["q" * 2000 + str(number) for number in range(300_000)]
    options = {"use_dictionary": False, "column_encoding": {"x": "DELTA_BYTE_ARRAY"}}
    pq.write_table(pa.table({"x": texts}), path, **options)


@pytest.mark.parametrize("write", [chunk, deflated, dictionary, runs, prefixes])
def test_a_small_file_that_expands_is_refused_within_a_gigabyte(tmp_path, monkeypatch, write):
    path = tmp_path / f"a.{'h5' if write in (chunk, deflated) else 'parquet'}"
    write(path)
    assert path.stat().st_size < 3_000_000
    isolated._READER.close()
    peaks, close = [], isolated.Child.close

    def measure(child):
        if child._process is not None:
            peaks.append(Path(f"/proc/{child._process.pid}/status").read_text())
        close(child)

    monkeypatch.setattr(isolated.Child, "close", measure)
    hdf5 = path.suffix == ".h5"
    with pytest.raises(InputError, match=path.name):
        read_hdf5(path, {"x": (None, None)}) if hdf5 else read_parquet(path, ["x"])
    isolated._READER.close()
    (peak,) = re.findall(r"VmHWM:\s+(\d+) kB", peaks[0])
    assert int(peak) < 1 << 20


def test_a_child_ends_with_a_parent_that_is_killed():
    program = (
        "import os, time\n"
        "from egosim_jax.io.untrusted.isolated import Child\n"
        "child = Child()\n"
        "print(child.call(os.getpid, timeout_s=60.0), flush=True)\n"
        "child.call(time.sleep, 600, timeout_s=600.0)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as parent:
        status = Path(f"/proc/{int(parent.stdout.readline())}/status")
        parent.kill()
    until = time.monotonic() + 20
    while status.exists() and "State:\tZ" not in status.read_text():
        assert time.monotonic() < until
        time.sleep(0.05)
