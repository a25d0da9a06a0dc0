"""`egosim-train NAME`: run a recipe."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Annotated

import tyro

from egosim_jax import command
from egosim_jax.train import recipes

Recipes = (
    Annotated[recipes.Debug, tyro.conf.subcommand("debug")]
    | Annotated[recipes.RealTiny, tyro.conf.subcommand("real_tiny")]
    | Annotated[recipes.Tabletop, tyro.conf.subcommand("tabletop")]
    | Annotated[recipes.Egosim14B, tyro.conf.subcommand("egosim_14b")]
    | Annotated[recipes.Egosim1B, tyro.conf.subcommand("egosim_1_3b")]
    | Annotated[recipes.Egosim14BRobot, tyro.conf.subcommand("egosim_14b_robot")]
    | Annotated[recipes.Egosim14BFewshot, tyro.conf.subcommand("egosim_14b_fewshot")]
    | Annotated[recipes.Egosim14BLora, tyro.conf.subcommand("egosim_14b_lora")]
)


def main(args: Sequence[str] | None = None) -> int:
    """Run `egosim-train`; with `args`, in a process that may have used its devices already."""
    from egosim_jax.train.distributed import joined

    return command.main(
        Recipes,
        program="egosim-train",
        description="Train a model. The same command resumes an interrupted run.",
        args=args,
        within=joined if args is None else nullcontext,
    )


if __name__ == "__main__":
    sys.exit(main())
