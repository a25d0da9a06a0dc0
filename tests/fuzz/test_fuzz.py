"""A minute of every fuzzer, with a seed that is always the same."""

import pytest

from tests.fuzz.runner import run
from tests.fuzz.worker import targets

pytestmark = pytest.mark.slow
SECONDS = 60
NAMES = [target.name for target in targets()]


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_is_refused_or_read_as_it_was(name):
    counts = run(name, seed=0, cases=1000, seconds=SECONDS / len(NAMES))
    assert counts.cases > 0
    assert not counts.failures
