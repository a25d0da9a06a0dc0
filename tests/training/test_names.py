"""The name of a recipe on the command line of `egosim train`."""

import sys
from dataclasses import replace
from types import ModuleType

import pytest

from egosim_jax.train import __main__ as program
from egosim_jax.train.recipes import get


@pytest.fixture
def given(monkeypatch):
    """Return the command line, and the names of the recipes, that the program parses."""
    parsed = {}

    def main(commands, *, args, **_):
        names = [kind.__metadata__[0].name for kind in commands.__args__]
        parsed.update(args=args, names=names)
        return 0

    monkeypatch.setattr(program.command, "main", main)
    return parsed


@pytest.mark.parametrize(
    "args",
    [
        ["debug", "--out", "x"],
        ["--config", "debug", "--out", "x"],
        ["--out", "x", "--config=debug"],
    ],
)
def test_the_name_is_an_option_or_the_first_argument(given, args):
    assert program.main(args) == 0
    assert given["args"] == ["debug", "--out", "x"]


def test_a_recipe_of_another_module_is_a_command(given, monkeypatch):
    theirs = ModuleType("theirs")
    theirs.LARGER = replace(get("egosim_14b_lora"), rank=32)
    monkeypatch.setitem(sys.modules, "theirs", theirs)
    assert program.main(["theirs:LARGER", "--out", "x"]) == 0
    assert "theirs:LARGER" in given["names"]


def test_an_unknown_module_is_refused(given, capsys):
    assert program.main(["nowhere:RECIPE"]) == 2
    assert "(--config)" in capsys.readouterr().err
    assert not given
