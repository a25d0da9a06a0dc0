"""Some cases of the fuzzers whose files expand; `test_fuzz` runs all fuzzers for longer."""

import pytest

from tests.fuzz.runner import run

CASES = {
    "episode zip": 25, "r3d": 25, "hdf5": 25, "parquet": 15, "tar of HOT3D": 25, "page of a run": 8,
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_file_that_expands_is_refused_or_read_within_bounds(name):
    counts = run(name, seed=1, cases=CASES[name])
    assert counts.cases == CASES[name]
    assert not counts.failures
