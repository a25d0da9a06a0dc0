"""Messages that name a file once, and numbers that differ from their limits."""

import pytest

from egosim_jax.io.bounded import named, unlike
from egosim_jax.types import InputError


@pytest.mark.parametrize(
    ("name", "text", "shown"),
    [
        ("a.ply", "a.ply cannot be read: it is empty.", "a.ply cannot be read: it is empty."),
        ("a.ply", "no colors.", "a.ply: no colors."),
        ("shard-0 record 3", "shard-0 record 3 is damaged", "shard-0 record 3 is damaged"),
        ("b", "a.ply cannot be read", "b: a.ply cannot be read"),
    ],
)
def test_a_file_is_named_once(name, text, shown):
    assert named(name, InputError(text)) == shown


@pytest.mark.parametrize(
    ("value", "limit", "shown"),
    [
        (49.7, 50.0, "49.7"),
        (49.97, 50.0, "49.97"),
        (115.00004, 115.0, "115.00004"),
        (79.6, 80.0, "79.6"),
        (12.3456, 50.0, "12.3"),
        (0.0, 1.0, "0"),
        (float("nan"), 1.0, "nan"),
        (50.0, 50.0, "50.0"),
    ],
)
def test_a_number_is_never_shown_as_the_limit_that_it_breaks(value, limit, shown):
    assert unlike(value, limit) == shown
