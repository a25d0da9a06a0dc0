"""The 52 channels against plain loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.conditioning import assemble, condition_channels
from egosim_jax.conditioning.assemble import CHANNELS, HANDS, MASK, NOISY, PRIOR
from egosim_jax.types import Condition

GRID = (2, 3, 2, 4)


@pytest.fixture(scope="module")
def arrays():
    rng = np.random.default_rng(0)
    arrays = {
        name: rng.standard_normal((*GRID, 16)).astype(np.float32)
        for name in ("noisy", "prior", "hands")
    }
    return {**arrays, "mask": rng.integers(0, 2, (*GRID, 4)).astype(np.float32)}


@pytest.fixture(scope="module")
def condition(arrays):
    return Condition(
        mask=jnp.asarray(arrays["mask"]),
        prior=jnp.asarray(arrays["prior"]),
        hands=jnp.asarray(arrays["hands"]),
        text=jnp.zeros((2, 5, 8)),
    )


def test_the_order_is_noisy_mask_prior_hands(arrays, condition):
    assembled = assemble(jnp.asarray(arrays["noisy"]), condition)
    assert assembled.shape == (*GRID, 52)
    for cell in np.ndindex(*GRID):
        expected = [arrays["noisy"][cell][c] for c in range(16)]
        expected += [arrays["mask"][cell][c] for c in range(4)]
        expected += [arrays["prior"][cell][c] * (1 - arrays["mask"][cell][0]) for c in range(16)]
        expected += [arrays["hands"][cell][c] for c in range(16)]
        np.testing.assert_array_equal(assembled[cell], expected)


def test_the_slices_name_what_they_hold(arrays, condition):
    assembled = assemble(jnp.asarray(arrays["noisy"]), condition)
    np.testing.assert_array_equal(assembled[..., NOISY], arrays["noisy"])
    np.testing.assert_array_equal(assembled[..., MASK], arrays["mask"])
    np.testing.assert_array_equal(
        assembled[..., PRIOR], arrays["prior"] * (1 - arrays["mask"][..., :1])
    )
    np.testing.assert_array_equal(assembled[..., HANDS], arrays["hands"])
    assert CHANNELS == 52


@pytest.mark.parametrize(("channel", "kept"), [(0, False), (1, True), (2, True), (3, True)])
def test_only_the_first_mask_channel_masks_the_prior(channel, kept):
    ones = jnp.ones((1, 1, 1, 1, 16))
    mask = jnp.zeros((1, 1, 1, 1, 4)).at[..., channel].set(1)
    condition = Condition(mask=mask, prior=ones, hands=ones, text=jnp.zeros((1, 1, 1)))
    prior = assemble(ones, condition)[..., PRIOR]
    assert (prior == (1 if kept else 0)).all()


def test_an_unobserved_cell_is_latent_zero_and_its_hands_stay():
    prior, hands = jnp.full((1, 1, 1, 1, 16), 3.0), jnp.full((1, 1, 1, 1, 16), 2.0)
    condition = Condition(
        mask=jnp.ones((1, 1, 1, 1, 4)), prior=prior, hands=hands, text=jnp.zeros((1, 1, 1))
    )
    channels = np.ravel(condition_channels(condition))
    assert channels.tolist() == [1] * 4 + [0] * 16 + [2] * 16


def test_the_channels_take_the_dtype_of_the_prior(condition):
    half = jax.tree.map(lambda x: x.astype(jnp.bfloat16), condition)
    packed = np.asarray(condition.mask).astype(np.uint8)
    channels = condition_channels(
        Condition(mask=packed, prior=half.prior, hands=condition.hands, text=half.text)
    )
    assert channels.dtype == jnp.bfloat16
    np.testing.assert_array_equal(channels[..., :4], packed)


def test_a_condition_is_a_pytree_with_and_without_an_image(condition):
    assert len(jax.tree.leaves(condition)) == 4
    doubled = jax.jit(lambda c: jax.tree.map(lambda x: 2 * x, c))(condition)
    np.testing.assert_array_equal(doubled.hands, 2 * condition.hands)
    assert doubled.image is None
