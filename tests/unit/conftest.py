"""Tiny clips on disk, in the layout of EgoSim's metadata."""

from functools import partial

import pytest

from egosim_jax import testing


@pytest.fixture
def make_clips(tmp_path):
    """Return a function that writes so many clips and their metadata (`testing.write_dataset`)."""
    return partial(testing.write_dataset, tmp_path)


@pytest.fixture
def clips(make_clips):
    """Metadata of two clips of 9 frames, 48x32."""
    return make_clips()
