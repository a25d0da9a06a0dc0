"""How every command ends: with an exit code that a script can act on.

0 done    1 failed    2 bad usage or input    3 some items failed
70 hung   75 saved and to be resubmitted
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

from egosim_jax.types import InputError

DONE, FAILED, USAGE, PARTIAL, HUNG, RESUBMIT = 0, 1, 2, 3, 70, 75


@runtime_checkable
class Command(Protocol):
    """A parsed command line."""

    def run(self) -> int:
        """Do the work and give the exit code."""
        ...


def main(commands: Any, *, program: str, description: str, args: Sequence[str] | None) -> int:
    """Parse a command line into one of the dataclasses `commands`, run it, give its exit code.

    Results go to stdout, progress and errors to stderr. A wrong option or bad input is one clear
    message; a traceback means that something is broken.
    """
    import tyro

    command: Command = tyro.cli(
        commands,
        prog=program,
        description=description,
        args=args,
        config=(tyro.conf.OmitSubcommandPrefixes,),
    )
    return guarded(command.run)


def guarded(run: Callable[[], int]) -> int:
    """Run, turning exceptions into exit codes."""
    try:
        return run()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return USAGE
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return FAILED
    except Exception:  # everything else is a failure of ours; the traceback says where
        traceback.print_exc()
        return FAILED
