"""The program `egosim`: its subcommands, its start page and its entry point."""

from __future__ import annotations

from egosim_jax.runtime import interrupts

interrupts.expect()  # before the slow imports, during which Ctrl-C may already come

import sys
from collections.abc import Sequence
from dataclasses import make_dataclass
from functools import reduce
from importlib import import_module
from operator import or_
from typing import Annotated, Any

import tyro

from egosim_jax.cli.data import Data
from egosim_jax.cli.doctor import Doctor
from egosim_jax.cli.episode import Episode
from egosim_jax.cli.evaluate import Evaluate
from egosim_jax.cli.experiment import Experiment
from egosim_jax.cli.generate import Generate
from egosim_jax.cli.models import Models
from egosim_jax.cli.play import Play
from egosim_jax.cli.preflight import Preflight
from egosim_jax.cli.rank import Rank
from egosim_jax.cli.robot import Robot
from egosim_jax.cli.serve import Serve
from egosim_jax.cli.simulate import Simulate
from egosim_jax.cli.table import TableCommand
from egosim_jax.cli.view import View
from egosim_jax.runtime import command

Commands = (
    Annotated[Generate, tyro.conf.subcommand("generate")]
    | Annotated[Preflight, tyro.conf.subcommand("preflight")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Episode, tyro.conf.subcommand("episode")]
    | Annotated[Play, tyro.conf.subcommand("play")]
    | Annotated[Serve, tyro.conf.subcommand("serve")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[TableCommand, tyro.conf.subcommand("table")]
    | Annotated[Rank, tyro.conf.subcommand("rank")]
    | Annotated[Data, tyro.conf.subcommand("data")]
    | Annotated[Robot, tyro.conf.subcommand("robot")]
    | Annotated[Models, tyro.conf.subcommand("models")]
    | Annotated[Experiment, tyro.conf.subcommand("experiment")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)


PROGRAMS = {"train": "egosim_jax.train.__main__", "convert": "egosim_jax.convert.__main__"}
"""Subcommands that are separate programs, imported only when they are called."""

START = """\
egosim: an egocentric world simulator in JAX

  egosim simulate                            three clips of a scene, with the model in the package
  egosim play                                the same world by hand, in the browser
  egosim generate --config tabletop          one clip; --metadata FILE generates your own
  egosim data annotate VIDEO --out DIR       scene, cameras and hands from your own video
  egosim episode make --out DIR              an episode to edit: scene, cameras, hands, prompts
  egosim serve                               a world for policies to step, over websocket or HTTP
  egosim models list                         models, and where their weights are
  egosim train debug --out DIR               train for minutes; egosim train --help lists all
  egosim doctor                              devices, versions, extras and weights

egosim --help describes all commands, egosim COMMAND --help one with its options."""
"""Page that `egosim` alone prints."""


def main(args: Sequence[str] | None = None) -> int:
    """Run the command `egosim`; return its exit code."""
    given = list(sys.argv[1:] if args is None else args)
    if not given:
        print(START)
        return command.ExitCode.DONE
    if given[0] in PROGRAMS:
        program = f"egosim {given[0]}"
        run = import_module(PROGRAMS[given[0]]).main
        if args is not None:
            return run(given[1:], program=program)
        sys.argv = [program, *given[1:]]
        return run(program=program)
    return command.main(
        _with_programs() if any(arg.startswith("--tyro-") for arg in given) else Commands,
        program="egosim",
        description="An egocentric world simulator in JAX. `egosim train` trains a model and "
        "`egosim convert` converts weights; each has its own --help.",
        args=args,
        others=tuple(PROGRAMS),
    )


def _with_programs() -> Any:
    """Return all commands, including `PROGRAMS`, for the shell completion of tyro."""
    found: list[Any] = [Commands]
    for name, module in PROGRAMS.items():
        kind = make_dataclass(name, [("command", import_module(module).Commands)])
        found.append(Annotated[kind, tyro.conf.subcommand(name)])
    return reduce(or_, found)


if __name__ == "__main__":
    sys.exit(main())
