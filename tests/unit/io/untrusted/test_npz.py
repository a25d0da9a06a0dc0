"""Arrays from npz files."""

import gc
import io
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from egosim_jax.io.untrusted.npz import read_arrays, read_npy
from egosim_jax.types import InputError


def npy(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_either_order_are_read(tmp_path, order):
    values = np.arange(24.0).reshape(2, 3, 4)
    np.savez(tmp_path / "a.npz", x=np.asarray(values, order=order))
    read = read_arrays(tmp_path / "a.npz", {"x": "f8"})["x"]
    np.testing.assert_array_equal(read, values)
    assert read.flags.c_contiguous


SHAPES = [(), (0,), (7,), (2, 3), (1, 0, 5), (12, 1, 1, 3)]


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<f2", "u1", "?", "<i8", ">u4"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_every_array_of_numbers_is_read_as_by_numpy(dtype, order):
    for shape in SHAPES:
        values = np.random.default_rng(0).integers(0, 2, shape).astype(dtype, order=order)
        found = read_npy(npy(values), "x")
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"'descr'", b"'descs'"),
        (b"(2, 3), }", b"(2  3), }"),
        (b"(2, 3), }", b"(6 ), }  "),
        (b"(2, 3), }", b"(02, 3),}"),
        (b"(2, 3), }", b"(-2,-3),}"),
        (b"(2, 3), }", b"(2, 3), ,"),
        (b"(2, 3), }", b"(2, 3) 1}"),
        (b"'<f4'", b"'<f3'"),
        (b"'<f4'", b"'<M8'"),
        (b"'<f4'", b"\"<f4'"),
        (b"False", b"0    "),
        (b"NUMPY\x01", b"NUMPY\x03"),
    ],
    ids=str,
)
def test_a_header_that_numpy_refuses_is_refused(old, new):
    data = npy(np.zeros((2, 3), "<f4"))
    assert data.count(old) == 1
    with pytest.raises(ValueError, match="x "):
        read_npy(data.replace(old, new), "x")
    if b"M8" not in new:
        with pytest.raises(Exception):  # noqa: B017
            np.load(io.BytesIO(data.replace(old, new)))


def test_threads_read_arrays_while_garbage_is_collected(tmp_path):
    """Python 3.11 raised a SystemError in `ast`, and a server's step failed."""
    np.savez(tmp_path / "a.npz", x=np.zeros((2, 3), np.float32))

    def read(_):
        for _ in range(30):
            assert read_arrays(tmp_path / "a.npz", {"x": "f4"})["x"].shape == (2, 3)

    interval, threshold = sys.getswitchinterval(), gc.get_threshold()
    callback = lambda *_: sum(range(20))  # noqa: E731
    gc.callbacks.append(callback)
    try:
        sys.setswitchinterval(1e-6)
        gc.set_threshold(20)
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(read, range(8)))
    finally:
        gc.callbacks.remove(callback)
        gc.set_threshold(*threshold)
        sys.setswitchinterval(interval)


def test_an_array_of_objects_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.array([{}], object))
    with pytest.raises(InputError, match=r"a\.npz is damaged: .*holds object"):
        read_arrays(tmp_path / "a.npz", {}, others=("x",))
