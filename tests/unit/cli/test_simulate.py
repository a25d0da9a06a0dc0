"""`egosim simulate`: refused options and the table of scores."""

import pytest

from egosim_jax.cli import simulate
from egosim_jax.evaluation.metrics.loop import MEASURES
from egosim_jax.types import InputError


def test_clips_with_other_ground_truth_have_empty_cells(capsys):
    names = list(MEASURES)
    report = [
        {"clip": 1, "action": "lift", names[0]: 1.0},
        {"clip": 2, "action": "drop", names[1]: 2.0},
        {"clip": 3, "action": "wave"},
    ]
    simulate._print(report)
    table = capsys.readouterr().out
    for text in (MEASURES[names[0]][0], MEASURES[names[1]][0], "1: lift", "2: drop", "3: wave"):
        assert text in table


def test_a_perception_of_a_state_that_is_kept_is_refused():
    with pytest.raises(InputError, match="oracle has no effect with --update none"):
        simulate.Simulate(perception="oracle", update="none").run()
