"""Rotary positions against the complex formula, element by element."""

import cmath

import jax.numpy as jnp
import numpy as np

from egosim_jax.models import rope

ROUNDING = 1e-6
"""Tolerance of float32 cosines, sines and products of numbers near 1."""


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


def test_tables_are_exact_to_float32_at_far_positions():
    rotation = np.asarray(rope.rotations(1000, 1, 1, 12))
    angle = 999 * 10000.0 ** (-1 / 2)
    c, s = np.cos(angle), np.sin(angle)
    np.testing.assert_allclose(rotation[999, 2:4], [[c, -s], [c, s]], atol=6e-8)


def test_larger_tokens_are_at_the_middle_of_the_tokens_that_they_replace():
    # A head of 12 has two pairs of each axis, whose first turns by the position itself.
    cosines = np.asarray(rope.rotations(2, 2, 3, 12, side=2)).reshape(2, 2, 3, 6, 2, 2)[..., 0, 0]
    frames, rows, columns = (cosines[..., pair] for pair in (0, 2, 4))
    np.testing.assert_allclose(frames[:, 0, 0], np.cos([0, 1]), atol=ROUNDING)
    np.testing.assert_allclose(rows[0, :, 0], np.cos([0.5, 2.5]), atol=ROUNDING)
    np.testing.assert_allclose(columns[0, 0], np.cos([0.5, 2.5, 4.5]), atol=ROUNDING)
