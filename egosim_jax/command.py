"""How every command ends: with an exit code that a script can act on.

0 done    1 failed    2 bad usage or input    3 some items failed
70 hung   75 saved and to be resubmitted
"""

from __future__ import annotations

import difflib
import errno
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib import metadata
from typing import Any, Protocol, get_args, get_type_hints, runtime_checkable

from egosim_jax import interrupts
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

    given = list(sys.argv[1:] if args is None else args)

    def run() -> int:
        import tyro

        if given == ["--version"]:
            print(f"{program} {metadata.version('egosim-jax')}")
            return DONE
        if (mistake := _mistyped(commands, given, program)) is not None:
            raise InputError(mistake)
        command: Command = tyro.cli(
            commands,
            prog=program,
            description=f"{description} --version prints the version.",
            args=given,
            config=(tyro.conf.OmitSubcommandPrefixes,),
        )
        with within():
            return command.run()

    return guarded(run)


def _mistyped(commands: Any, args: Sequence[str], program: str) -> str | None:
    """Say which subcommand a word that is none may have meant; None if there is no mistake."""
    known = {part.__metadata__[0].name: part.__origin__ for part in get_args(commands)}
    if not known or not args or args[0].startswith("-"):
        return None
    if args[0] in known:
        below = get_type_hints(known[args[0]], include_extras=True).get("command")
        return _mistyped(below, args[1:], f"{program} {args[0]}") if below else None
    near = difflib.get_close_matches(args[0], known, n=1, cutoff=0.6)
    meant = f" Did you mean {near[0]}?" if near else ""
    return f"{program} has no command {args[0]!r}.{meant} All: {', '.join(known)}."


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
        interrupts.tell()
        return FAILED
    except Exception as error:
        if (reason := system_failure(error)) is not None:
            print(f"error: {reason}", file=sys.stderr)
        else:  # everything else is a failure of ours; the traceback says where
            traceback.print_exc()
        return FAILED


def system_failure(error: BaseException) -> str | None:
    """Describe in one line what the system refused (disk, permissions, memory); None if it did not.

    Libraries in C++ raise errors of their own, which name the system's reason in their text.
    """
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, MemoryError):
            return "not enough memory. Take less at a time, or a machine with more."
        text = str(seen).replace("\n", " ")
        for code in REFUSALS:
            reason = os.strerror(code)
            if (isinstance(seen, OSError) and seen.errno == code) or reason in text:
                name = getattr(seen, "filename", None)
                where = f"{name}: {reason}" if name else text[:300]
                return f"{where}. {REFUSALS[code]}"
        seen = seen.__cause__ or seen.__context__
    return None


_WRITABLE = "Choose a folder that can be written to. (--out)"
_RUN_AGAIN = "Free space and run the same command again; what is complete stays."
REFUSALS = {
    errno.ENOSPC: _RUN_AGAIN,
    errno.EDQUOT: _RUN_AGAIN,
    errno.EFBIG: _RUN_AGAIN,
    errno.EROFS: _WRITABLE,
    errno.EACCES: _WRITABLE,
    errno.EPERM: _WRITABLE,
    errno.ENOTDIR: "A file is where a folder has to be: choose another path.",
    errno.EISDIR: "A folder is where a file has to be: choose another path.",
    errno.EEXIST: "Something is in the way: choose another path.",
    errno.ENAMETOOLONG: "Choose a shorter path.",
    errno.ELOOP: "Links are not followed here: give the real path.",
    errno.ENOENT: "Check the path.",
    errno.EMFILE: "Raise the limit of open files (ulimit -n).",
    errno.EBUSY: "A mount point cannot be replaced: choose a folder inside it.",
    errno.EIO: "Check the disk.",
}
"""What the system may refuse, and the way out."""
