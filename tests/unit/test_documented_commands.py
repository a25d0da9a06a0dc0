"""Every command that the documents show is one that the programs understand."""

import re
import shlex
from pathlib import Path

import pytest
import tyro

from egosim_jax.cli.__main__ import Commands
from egosim_jax.convert.__main__ import Commands as Conversions
from egosim_jax.train.__main__ import Commands as Recipes

ROOT = Path(__file__).parents[2]
PROGRAMS = {"egosim": Commands, "egosim-train": Recipes, "egosim-convert": Conversions}
PATHS = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    ROOT / "egosim_jax" / "weights" / "tabletop" / "README.md",
    ROOT / "train" / "recipes.py",
]


COMMAND = re.compile(
    r"^    (?:srun .*? )?(?:[A-Z_]+=\S+ )*(egosim(?:-train|-convert)? .*?)(?: &)?$", re.M
)
"""In an indented line, behind what starts it and before what sends it to the background."""


def shown(path: Path) -> list[str]:
    """The commands in a document."""
    return COMMAND.findall(path.read_text("utf-8").replace("\\\n", " "))


COMMANDS = sorted({command for path in PATHS for command in shown(path)})


def test_there_are_commands_of_every_program():
    assert {command.split()[0] for command in COMMANDS} == PROGRAMS.keys()
    assert len(COMMANDS) > 40


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_is_understood(command):
    program, *args = shlex.split(command)
    if program == "egosim" and args[0] in ("train", "convert"):
        program = f"egosim-{args.pop(0)}"
    tyro.cli(PROGRAMS[program], args=args, config=(tyro.conf.OmitSubcommandPrefixes,))
