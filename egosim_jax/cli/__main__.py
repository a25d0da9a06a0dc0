"""The program `egosim`: its entry point and its start page. Heavy modules are imported later."""

from __future__ import annotations

from egosim_jax.runtime import interrupts, preemption

interrupts.expect()  # before the slow imports, during which Ctrl-C may already come

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from importlib import import_module
from typing import Any

from egosim_jax.runtime.phases import phase, show_phases

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
  egosim convert --help                      PyTorch weights to JAX, and back
  egosim doctor                              devices, versions, extras and weights

egosim --help describes all commands, egosim COMMAND --help one with its options."""
"""Page that `egosim` alone prints."""


ANNOUNCED = ("simulate", "generate", "evaluate", "play", "serve", "train", "data annotate")
"""Commands that load for seconds, and so print a line before the first import."""
RESUBMITTED = ("train", "data encode")
"""Commands that SIGTERM ends with the exit code 75, at any time."""


def main(args: Sequence[str] | None = None) -> int:
    """Run the command `egosim`; return its exit code."""
    given = list(sys.argv[1:] if args is None else args)
    if not given:
        print(START)
        return 0
    program = f"egosim {given[0]}"
    module = PROGRAMS.get(given[0], "egosim_jax.cli.commands")
    if args is None and _named(given, RESUBMITTED):
        preemption.expect()
    words = _named(given, ANNOUNCED)
    loaded = _load(module, f"egosim {words or given[0]}", announced=bool(words), options=given)
    if given[0] not in PROGRAMS:
        return loaded.run(args, programs=PROGRAMS)
    run = loaded.main
    if args is not None:
        return run(given[1:], program=program)
    sys.argv = [program, *given[1:]]
    return run(program=program)


def train() -> int:
    """Run the program `egosim-train`; return its exit code."""
    preemption.expect()
    loaded = _load(PROGRAMS["train"], "egosim-train", announced=True, options=sys.argv)
    return loaded.main()


def _named(given: Sequence[str], commands: Sequence[str]) -> str:
    """Return which of the commands a command line names; empty if none."""
    return next((name for name in commands if name.split() == given[: len(name.split())]), "")


def _load(module: str, program: str, *, announced: bool, options: Sequence[str]) -> Any:
    """Import a module, and print before it, if it loads for seconds, that its program starts."""
    with ExitStack() as starting:
        if announced and not {"-h", "--help"} & {*options}:
            starting.enter_context(show_phases())
        starting.enter_context(phase(f"starts {program}"))
        return import_module(module)


if __name__ == "__main__":
    sys.exit(main())
