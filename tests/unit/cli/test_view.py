"""Refusals of `egosim view`, by the folder."""

import pytest

from egosim_jax.cli.view import View
from egosim_jax.types import InputError


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("report.json", "cannot be viewed: give the folder of a simulation"),  # of an experiment
        ("journal.jsonl", "simulated without Rerun"),
        ("state.json", "not a readable state"),
    ],
)
def test_the_reason_is_that_of_the_folder(tmp_path, file, message):
    (tmp_path / file).write_text("{}")
    with pytest.raises(InputError, match=message):
        View(path=tmp_path).run()
