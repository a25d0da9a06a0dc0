"""`egosim-train NAME`: train a model by a recipe."""

from __future__ import annotations

from egosim_jax.runtime import interrupts, preemption

interrupts.expect()
if __name__ == "__main__":
    preemption.expect()

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Annotated, Any, Union

import tyro

from egosim_jax.runtime import command
from egosim_jax.runtime.terminal import printable
from egosim_jax.train.recipe import Recipe
from egosim_jax.train.recipes import RECIPES, REGISTRY
from egosim_jax.types import InputError


def _subcommand(name: str, about: str, recipe: Recipe) -> Any:
    subcommand = tyro.conf.subcommand(name, default=recipe, description=about)
    return Annotated[type(recipe), subcommand]


Commands = Union[  # noqa: UP007 - a tuple of members
    tuple(_subcommand(name, about, recipe) for name, (about, recipe) in RECIPES.items())
]


def _name_first(options: list[str]) -> list[str]:
    """Return the options with the name of the recipe first, also if `--config` gives it."""
    if not options or not options[0].startswith("-"):
        return options
    for place, option in enumerate(options):
        name, equals, value = option.partition("=")
        if name == "--config" and (equals or place + 1 < len(options)):
            value = value if equals else options[place + 1]
            return [value, *options[:place], *options[place + (1 if equals else 2) :]]
    return options


def _commands_with(name: str) -> Any:
    """Return all recipes, and the one of another package that a name is for, if any."""
    if name in RECIPES or (":" not in name and name not in REGISTRY.names()):
        return Commands
    recipe = REGISTRY.parse(name)
    return Union[Commands, _subcommand(name, f"Train by {name}.", recipe)]  # noqa: UP007


def main(args: Sequence[str] | None = None, *, program: str = "egosim-train") -> int:
    """Run `egosim-train`; with `args`, in a process that may already have used its devices."""
    options = _name_first(list(sys.argv[1:] if args is None else args))
    if args is None:
        sys.argv[1:] = options
    else:
        args = options
    if options[:1] == ["tabletop"] and "--online" in options:  # a training with other options
        from egosim_jax.train.online.command import Online

        return command.main(
            Online,
            program=f"{program} tabletop --online",
            description="Train while other processes make scenes. The same command resumes an "
            "interrupted run.",
            args=[option for option in options[1:] if option != "--online"],
        )
    from egosim_jax.train.distributed import training_context

    without_training = any(option.partition("=")[0] == "--preflight" for option in options)
    try:
        commands = _commands_with(options[0] if options else "")
    except InputError as error:
        print(f"error: {printable(error)}", file=sys.stderr)
        return command.ExitCode.USAGE
    return command.main(
        commands,
        program=program,
        description="Train a model. The same command resumes an interrupted run. With --preflight "
        "it only reports whether the training would fit a machine, which can be absent. `tabletop "
        "--online` trains while other processes make scenes, with other options.",
        args=args,
        context=training_context if args is None and not without_training else nullcontext,
    )


if __name__ == "__main__":
    sys.exit(main())
