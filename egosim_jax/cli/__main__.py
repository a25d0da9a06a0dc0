"""`egosim`: generate clips, simulate a world, evaluate, prepare data."""

from __future__ import annotations

from egosim_jax import interrupts

interrupts.expect()

import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from egosim_jax import command
from egosim_jax.cli.data import Data
from egosim_jax.cli.doctor import Doctor
from egosim_jax.cli.episode import Episode
from egosim_jax.cli.evaluate import Evaluate
from egosim_jax.cli.experiment import Experiment
from egosim_jax.cli.generate import Generate
from egosim_jax.cli.models import Models
from egosim_jax.cli.preflight import Preflight
from egosim_jax.cli.simulate import Simulate
from egosim_jax.cli.view import View

Commands = (
    Annotated[Generate, tyro.conf.subcommand("generate")]
    | Annotated[Preflight, tyro.conf.subcommand("preflight")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Episode, tyro.conf.subcommand("episode")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Data, tyro.conf.subcommand("data")]
    | Annotated[Models, tyro.conf.subcommand("models")]
    | Annotated[Experiment, tyro.conf.subcommand("experiment")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command `egosim`; return its exit code."""
    return command.main(
        Commands,
        program="egosim",
        description="An egocentric world simulator in JAX.",
        args=args,
    )


if __name__ == "__main__":
    sys.exit(main())
