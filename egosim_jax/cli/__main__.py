"""`egosim`: generate clips, simulate a world, compare with the truth, prepare data."""

from __future__ import annotations

from egosim_jax import interrupts

interrupts.expect()

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from egosim_jax import command
from egosim_jax.cli.data import Check, Encode, Look, Make, Pack, Stats
from egosim_jax.cli.doctor import Doctor
from egosim_jax.cli.evaluate import Evaluate
from egosim_jax.cli.generate import Generate
from egosim_jax.cli.models import Fetch, List
from egosim_jax.cli.plan import Plan
from egosim_jax.cli.simulate import Simulate
from egosim_jax.cli.view import View
from egosim_jax.experiments.continuous import Continuous
from egosim_jax.experiments.debug import Debug
from egosim_jax.experiments.embodiment import Embodiment
from egosim_jax.experiments.real_tiny import RealTiny
from egosim_jax.experiments.tabletop import Tabletop
from egosim_jax.experiments.update import Update


@dataclass(frozen=True, kw_only=True)
class Data:
    """Prepare data: clips of a procedural world, shards of videos, frames or latents."""

    command: (
        Annotated[Make, tyro.conf.subcommand("make")]
        | Annotated[Pack, tyro.conf.subcommand("pack")]
        | Annotated[Encode, tyro.conf.subcommand("encode")]
        | Annotated[Look, tyro.conf.subcommand("look")]
        | Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Stats, tyro.conf.subcommand("stats")]
    )

    def run(self) -> int:
        """Run the chosen command."""
        return self.command.run()


@dataclass(frozen=True, kw_only=True)
class Models:
    """List released weights by name; fetch and convert them."""

    command: (
        Annotated[List, tyro.conf.subcommand("list")]
        | Annotated[Fetch, tyro.conf.subcommand("fetch")]
    )

    def run(self) -> int:
        """Run the chosen command."""
        return self.command.run()


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Repeat a documented experiment: training, generation and its table, by one command."""

    command: (
        Annotated[Tabletop, tyro.conf.subcommand("tabletop")]
        | Annotated[Continuous, tyro.conf.subcommand("continuous")]
        | Annotated[Update, tyro.conf.subcommand("update")]
        | Annotated[Embodiment, tyro.conf.subcommand("embodiment")]
        | Annotated[RealTiny, tyro.conf.subcommand("real_tiny")]
        | Annotated[Debug, tyro.conf.subcommand("debug")]
    )

    def run(self) -> int:
        """Run the chosen experiment."""
        return self.command.run()


Commands = (
    Annotated[Generate, tyro.conf.subcommand("generate")]
    | Annotated[Plan, tyro.conf.subcommand("plan")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Data, tyro.conf.subcommand("data")]
    | Annotated[Models, tyro.conf.subcommand("models")]
    | Annotated[Experiment, tyro.conf.subcommand("experiment")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)


def main(args: Sequence[str] | None = None) -> int:
    """Run `egosim`."""
    return command.main(
        Commands,
        program="egosim",
        description="An egocentric world simulator in JAX.",
        args=args,
    )


if __name__ == "__main__":
    sys.exit(main())
