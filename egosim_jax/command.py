"""How every command ends: with an exit code that a script can act on.

0 done    1 failed    2 bad usage or input    3 some items failed
70 hung   75 saved and to be resubmitted
"""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from egosim_jax.types import InputError

DONE, FAILED, USAGE, PARTIAL, HUNG, RESUBMIT = 0, 1, 2, 3, 70, 75


class Stop(Exception):  # noqa: N818 - that a command ends early need not be an error
    """Ends a command with an exit code, after printing why."""

    def __init__(self, why: str, code: int):
        super().__init__(why)
        self.code = code


@runtime_checkable
class Command(Protocol):
    """A parsed command line."""

    def run(self) -> int:
        """Do the work and give the exit code."""
        ...


def main(
    commands: Any,
    *,
    program: str,
    description: str,
    args: Sequence[str] | None,
    within: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> int:
    """Parse a command line into one of the dataclasses `commands`, run it, give its exit code.

    What `within` gives is entered before the command runs and left after it.

    Results go to stdout, progress and errors to stderr. A wrong option or bad input is one clear
    message; a traceback means that something is broken.
    """
    import tyro

    _keep_compiled_programs()
    command: Command = tyro.cli(
        commands,
        prog=program,
        description=description,
        args=args,
        config=(tyro.conf.OmitSubcommandPrefixes,),
    )

    def run() -> int:
        with within():
            return command.run()

    return guarded(run)


def cache_folder() -> Path:
    """Of everything that can be made again."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "egosim_jax"


def _keep_compiled_programs() -> None:
    """Let jax keep what it compiles in a folder that only its user can read and write."""
    folder = cache_folder() / "compiled"
    with contextlib.suppress(OSError):  # without it everything works, but compiles each time
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))


def guarded(run: Callable[[], int]) -> int:
    """Run, turning exceptions into exit codes."""
    try:
        return run()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return USAGE
    except Stop as stop:
        print(stop, file=sys.stderr)
        return stop.code
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return FAILED
    except Exception:  # everything else is a failure of ours; the traceback says where
        traceback.print_exc()
        return FAILED
