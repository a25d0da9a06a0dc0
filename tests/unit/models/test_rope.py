"""Rotary positions against the complex formula, element by element."""

import cmath

import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.models import rope

ROUNDING = 1e-6
"""Tolerance of float32 cosines, sines and products of numbers near 1."""


def test_a_head_of_128_has_22_21_and_21_pairs():
    assert rope.pairs(128) == (22, 21, 21)


@pytest.mark.parametrize("head_dim", [6, 16, 24, 64, 128])
def test_pairs_fill_the_head(head_dim):
    assert sum(rope.pairs(head_dim)) == head_dim // 2
    assert min(rope.pairs(head_dim)) >= 1


def test_every_pair_turns_by_its_axis_position_times_its_frequency():
    frames, rows, columns, head_dim = 3, 4, 5, 16
    x = np.random.default_rng(0).standard_normal((1, 60, 2, head_dim)).astype(np.float32)
    have = np.asarray(rope.rotate(jnp.asarray(x), rope.rotations(frames, rows, columns, head_dim)))
    for frame, row, column in [(0, 0, 0), (2, 0, 1), (1, 3, 4), (2, 3, 4)]:
        token = (frame * rows + row) * columns + column
        places = [(frame, i, 4) for i in range(4)]
        places += [(row, i, 2) for i in range(2)] + [(column, i, 2) for i in range(2)]
        for pair, (position, i, count) in enumerate(places):
            turn = cmath.exp(1j * position * 10000 ** (-i / count))
            for head in range(2):
                a, b = x[0, token, head, 2 * pair : 2 * pair + 2]
                want = complex(a, b) * turn
                got = complex(*have[0, token, head, 2 * pair : 2 * pair + 2])
                assert abs(got - want) <= ROUNDING * max(1, abs(want))


def test_products_depend_on_relative_positions_only():
    draw = np.random.default_rng(1).standard_normal
    query, key = (np.repeat(draw((1, 1, 1, 24)), 6 * 6 * 6, axis=1) for _ in range(2))
    rotation = rope.rotations(6, 6, 6, 24)
    q, k = (np.asarray(rope.rotate(jnp.float32(x), rotation))[0, :, 0] for x in (query, key))
    grid = np.arange(216).reshape(6, 6, 6)
    products = [q[grid[2 + i, 1 + i, 3 + i]] @ k[grid[i, 2 + i, 1 + i]] for i in (0, 1, 2)]
    np.testing.assert_allclose(products, products[0], rtol=0, atol=24 * ROUNDING)
    assert abs(q[grid[2, 1, 3]] @ k[grid[0, 0, 0]] - products[0]) > 1e-2


def test_tables_are_exact_to_float32_at_far_positions():
    rotation = np.asarray(rope.rotations(1000, 1, 1, 12))
    angle = 999 * 10000.0 ** (-1 / 2)
    c, s = np.cos(angle), np.sin(angle)
    np.testing.assert_allclose(rotation[999, 2:4], [[c, -s], [c, s]], atol=6e-8)
