"""Some cases of the fuzzers whose files expand; `test_fuzz` runs all fuzzers for longer."""

import pytest

from tests.fuzz.runner import run

NAMES = ("episode zip", "r3d", "hdf5", "parquet", "tar of HOT3D", "page of a run")


@pytest.mark.parametrize("name", NAMES)
def test_a_file_that_expands_is_refused_or_read_within_bounds(name):
    counts = run(name, seed=1, cases=25)
    assert counts.cases == 25
    assert not counts.failures
