"""The forms of the causal convolution against each other."""

import jax
import numpy as np
import pytest

from egosim_jax.models.causal_conv import by_image, direct

TOLERANCE = 1e-5
"""Relative L2 in float32: the order of sums over up to 27 x 12 channels or 3 x 32 x 32 places."""

CASES = {
    "small image": ((2, 4, 6, 5, 12), (3, 3, 3, 12, 7)),
    "large image": ((1, 5, 32, 34, 12), (3, 3, 3, 12, 7)),
    "large image, few channels in": ((1, 4, 32, 32, 3), (3, 3, 3, 3, 10)),
    "large image, few channels out": ((1, 4, 32, 32, 10), (3, 3, 3, 10, 3)),
    "time only": ((1, 4, 32, 32, 9), (3, 1, 1, 9, 18)),
    "space only": ((1, 2, 32, 32, 12), (1, 3, 3, 12, 6)),
    "no frame to return": ((1, 2, 6, 5, 12), (3, 3, 3, 12, 7)),
}


def draw(case):
    normal = np.random.default_rng(0).normal
    x, kernel = (normal(size=shape).astype(np.float32) for shape in CASES[case])
    frames = x.shape[1] - kernel.shape[0] + 1
    dy = normal(size=(x.shape[0], frames, *x.shape[2:4], kernel.shape[-1])).astype(np.float32)
    return x, kernel, dy


def relative_error(have, want):
    return np.linalg.norm(have - want) / max(np.linalg.norm(want), 1e-30)


@pytest.mark.parametrize("case", CASES)
def test_the_form_of_the_cpu_is_the_3d_convolution(case):
    x, kernel, _ = draw(case)
    with jax.default_matmul_precision("highest"):
        have, want = jax.jit(by_image)(x, kernel), jax.jit(direct)(x, kernel)
    assert have.shape == want.shape
    assert relative_error(have, want) <= TOLERANCE


@pytest.mark.parametrize("case", CASES)
def test_its_gradients_are_those_of_the_3d_convolution(case):
    def gradients(form, x, kernel, dy):
        return jax.vjp(form, x, kernel)[1](dy)

    with jax.default_matmul_precision("highest"):
        have, want = (
            jax.jit(gradients, static_argnums=0)(f, *draw(case)) for f in (by_image, direct)
        )
    for mine, theirs in zip(have, want, strict=True):
        assert mine.shape == theirs.shape
        assert relative_error(mine, theirs) <= TOLERANCE
