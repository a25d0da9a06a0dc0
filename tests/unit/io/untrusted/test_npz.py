"""Arrays from npz files."""

import numpy as np
import pytest

from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.types import InputError


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_either_order_are_read(tmp_path, order):
    values = np.arange(24.0).reshape(2, 3, 4)
    np.savez(tmp_path / "a.npz", x=np.asarray(values, order=order))
    read = read_arrays(tmp_path / "a.npz", {"x": "f8"})["x"]
    np.testing.assert_array_equal(read, values)
    assert read.flags.c_contiguous


def test_an_array_of_objects_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.array([{}], object))
    with pytest.raises(InputError, match=r"a\.npz is damaged: .*holds object"):
        read_arrays(tmp_path / "a.npz", {}, others=("x",))
