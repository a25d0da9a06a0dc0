"""`egosim-train NAME`: train a model by a recipe."""

from __future__ import annotations

from egosim_jax.runtime import interrupts

interrupts.expect()

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Annotated, Union

import tyro

from egosim_jax.runtime import command
from egosim_jax.train.recipes import RECIPES

Commands = Union[  # noqa: UP007 - a tuple of members
    tuple(
        Annotated[type(recipe), tyro.conf.subcommand(name, default=recipe, description=about)]
        for name, (about, recipe) in RECIPES.items()
    )
]


def main(args: Sequence[str] | None = None, *, program: str = "egosim-train") -> int:
    """Run `egosim-train`; with `args`, in a process that may already have used its devices."""
    options = list(sys.argv[1:] if args is None else args)
    if options[:1] == ["tabletop"] and "--online" in options:  # a parser for machines without tyro
        from egosim_jax.train.online.__main__ import main as train_online

        given = [option for option in options[1:] if option != "--online"]
        return train_online(given, program=f"{program} tabletop --online")
    from egosim_jax.train.distributed import training_context

    without_training = any(option.partition("=")[0] == "--preflight" for option in options)
    return command.main(
        Commands,
        program=program,
        description="Train a model. The same command resumes an interrupted run. With --preflight "
        "it only reports whether the training would fit a machine, which can be absent. `tabletop "
        "--online` trains while other processes make scenes, with other options.",
        args=args,
        context=training_context if args is None and not without_training else nullcontext,
    )


if __name__ == "__main__":
    sys.exit(main())
