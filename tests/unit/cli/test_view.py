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


def test_a_page_that_exists_is_printed_and_not_written_elsewhere(tmp_path, capsys):
    for name in ("report.json", "index.html"):
        (tmp_path / name).write_text("{}")
    View(path=tmp_path).run()
    assert capsys.readouterr().out.strip() == str(tmp_path / "index.html")
    with pytest.raises(InputError, match="would not be written"):
        View(path=tmp_path, out=tmp_path / "other.html").run()
