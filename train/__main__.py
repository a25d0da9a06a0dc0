"""`egosim-train NAME`: run a recipe."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from egosim_jax import command
from egosim_jax.train import recipes

Recipes = (
    Annotated[recipes.Debug, tyro.conf.subcommand("debug")]
    | Annotated[recipes.RealTiny, tyro.conf.subcommand("real_tiny")]
    | Annotated[recipes.Tabletop, tyro.conf.subcommand("tabletop")]
)


def main(args: Sequence[str] | None = None) -> int:
    """Run `egosim-train`."""
    return command.main(
        Recipes,
        program="egosim-train",
        description="Train a model. The same command resumes an interrupted run.",
        args=args,
    )


if __name__ == "__main__":
    sys.exit(main())
