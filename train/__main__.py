"""`egosim-train NAME`: run a recipe."""

from __future__ import annotations

from egosim_jax import interrupts

interrupts.expect()

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import MISSING, fields
from typing import Annotated, get_args

import tyro

from egosim_jax import command
from egosim_jax.train import recipes
from egosim_jax.train.config import Recipe

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

    given = sys.argv[1:] if args is None else args
    without_training = any(arg.partition("=")[0] == "--preflight" for arg in given)
    return command.main(
        Recipes,
        program="egosim-train",
        description="Train a model. The same command resumes an interrupted run. With --preflight "
        "it only says whether the training would fit a machine that need not be there.",
        args=with_paths(given) if without_training else given,
        context=joined if args is None and not without_training else nullcontext,
    )


def with_paths(args: Sequence[str]) -> list[str]:
    """The arguments of a preflight, with those that only a training needs: paths, which it uses."""
    known = {part.__metadata__[0].name: part.__origin__ for part in get_args(Recipes)}
    needed = [
        f"--{field.name}"
        for field in fields(known.get(args[0], Recipe))
        if field.default is MISSING and field.default_factory is MISSING
    ]
    missing = [option for option in needed if option not in args]
    return [*args, *(word for option in missing for word in (option, "-"))]


if __name__ == "__main__":
    sys.exit(main())
