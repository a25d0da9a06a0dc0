"""Products of rounded factors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.models.layers import Linear, rounded_product

SUMS = 1e-6
"""Relative L2 between sums of the same products in float32 and in float64."""


def rounded(x):
    return np.asarray(jnp.asarray(x, jnp.bfloat16), np.float64)


def relative(have, want):
    return np.linalg.norm(have - want) / np.linalg.norm(want)


@pytest.fixture
def factors():
    normal = np.random.default_rng(0).normal
    return [
        jnp.asarray(normal(size=shape), jnp.float32) for shape in ((2, 3, 40), (40, 24), (2, 3, 24))
    ]


def test_a_rounded_product_rounds_its_factors_and_nothing_else(factors):
    x, kernel, _ = factors
    have = rounded_product(x, kernel)
    assert have.dtype == jnp.float32
    assert relative(have, rounded(x) @ rounded(kernel)) < SUMS
    assert 1e-4 < relative(have, x @ kernel) < 1e-2


def test_so_do_the_products_of_its_gradient(factors):
    x, kernel, g = factors
    dx, dkernel = jax.vjp(rounded_product, x, kernel)[1](g)
    assert relative(dx, rounded(g) @ rounded(kernel).T) < SUMS
    want = np.einsum("abi,abo->io", rounded(x), rounded(g))
    assert relative(dkernel, want) < SUMS
    assert dx.dtype == dkernel.dtype == jnp.float32


def test_a_linear_layer_rounds_only_on_request(factors):
    x, kernel, _ = factors
    exact = Linear(40, 24, axes=(None, None), rngs=nnx.Rngs(0))
    rounding = Linear(40, 24, axes=(None, None), products="bfloat16", rngs=nnx.Rngs(0))
    exact.kernel[...] = rounding.kernel[...] = kernel
    np.testing.assert_array_equal(exact(x), x @ kernel)
    np.testing.assert_array_equal(rounding(x), rounded_product(x, kernel))
