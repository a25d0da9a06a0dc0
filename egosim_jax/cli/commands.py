"""All subcommands of `egosim`, imported only when one of them runs."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass
from importlib import import_module
from typing import Any

from egosim_jax.cli.data import Data
from egosim_jax.cli.doctor import Doctor
from egosim_jax.cli.episode import Episode
from egosim_jax.cli.evaluate import Evaluate
from egosim_jax.cli.evaluate_policy import EvaluatePolicy
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

Commands = command.subcommands(
    {
        "generate": Generate,
        "preflight": Preflight,
        "simulate": Simulate,
        "episode": Episode,
        "play": Play,
        "serve": Serve,
        "view": View,
        "evaluate": Evaluate,
        "evaluate-policy": EvaluatePolicy,
        "table": TableCommand,
        "rank": Rank,
        "data": Data,
        "robot": Robot,
        "models": Models,
        "experiment": Experiment,
        "doctor": Doctor,
    }
)


def run(args: Sequence[str] | None, *, programs: Mapping[str, str]) -> int:
    """Run a subcommand, by default of the command line; return its exit code.

    `programs` are the modules of further subcommands, which are separate programs.
    """
    given = sys.argv[1:] if args is None else args
    completing = any(arg.startswith("--tyro-") for arg in given)
    return command.main(
        _with_programs(programs) if completing else Commands,
        program="egosim",
        description="An egocentric world simulator in JAX. `egosim train` trains a model and "
        "`egosim convert` converts weights; each has its own --help.",
        args=args,
        others=tuple(programs),
    )


def _with_programs(programs: Mapping[str, str]) -> Any:
    """Return all commands and the programs of some modules, for the shell completion of tyro."""
    kinds = {
        name: make_dataclass(name, [("command", import_module(module).Commands)])
        for name, module in programs.items()
    }
    return Commands | command.subcommands(kinds)
