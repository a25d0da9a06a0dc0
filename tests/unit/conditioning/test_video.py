import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.conditioning import to_model, to_uint8

LEVELS = np.arange(256, dtype=np.uint8)


@pytest.mark.parametrize("asarray", [np.asarray, jnp.asarray])
def test_levels_map_to_minus_one_to_one(asarray):
    x = to_model(asarray(LEVELS))
    assert x.dtype == np.float32
    assert (x[0], x[255]) == (-1, 1)
    for level in range(256):
        # Two roundings of float32 near 1.
        assert float(x[level]) == pytest.approx(level / 255 * 2 - 1, abs=2.5e-7)


@pytest.mark.parametrize("asarray", [np.asarray, jnp.asarray])
def test_values_are_truncated_not_rounded(asarray):
    # The middle of each step, where rounding would go up.
    middles = (LEVELS[:-1] + 0.75) / 255 * 2 - 1
    levels = to_uint8(asarray(middles.astype(np.float32)))
    assert levels.dtype == np.uint8
    np.testing.assert_array_equal(levels, LEVELS[:-1])


@pytest.mark.parametrize("asarray", [np.asarray, jnp.asarray])
def test_values_out_of_range_are_clipped(asarray):
    values = asarray(np.array([-3.0, -1.0, 1.0, 1.5], np.float32))
    assert to_uint8(values).tolist() == [0, 0, 255, 255]


@pytest.mark.parametrize("asarray", [np.asarray, jnp.asarray])
def test_there_and_back_loses_at_most_one_level(asarray):
    lost = LEVELS.astype(int) - np.asarray(to_uint8(to_model(asarray(LEVELS)))).astype(int)
    assert set(lost.tolist()) == {0, 1}
