"""Ctrl-C at any time: print one line, with the command that continues if there is work to keep.

A program imports this module and calls `expect` before its large imports, which take seconds. So it
imports only the standard library, and is not part of `command.py`.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

CODE = 128 + signal.SIGINT
"""Exit code after Ctrl-C, as of a program that the signal ends."""
PREPARED = ("config.json", "environment.json", "journal.jsonl")
"""Files of a run folder that are written before any result."""
AGAIN_S = 0.1
"""Seconds after which an interrupt that Python ignored comes again."""
_folders: set[Path] = set()
_options: list[str] = []


def expect() -> None:
    """Install the handler of Ctrl-C."""
    with suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, _interrupt)
        sys.unraisablehook = partial(_repeat, sys.unraisablehook)


def ignore() -> None:
    """Ignore Ctrl-C, once the work is done."""
    with suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def begin() -> None:
    """Forget what an earlier command of this process would continue."""
    _folders.clear()
    _options.clear()


def resume_from(folder: Path) -> None:
    """Remember that the command resumes from the results in a folder, if it has any."""
    _folders.add(folder.absolute())


def resume_by(option: str) -> None:
    """Remember an option without which the same command would begin again."""
    _options.append(option)


def print_interrupted() -> None:
    """Print that the command was interrupted, and the command line that continues its run."""
    if not any(map(_has_results, _folders)):
        print("interrupted", file=sys.stderr, flush=True)
        return
    program, *options = sys.argv
    options += [option for option in dict.fromkeys(_options) if option not in options]
    # `egosim train` is a program of two words (`cli/__main__.py`); others are paths.
    words = [program] if os.sep in program else program.split()
    command = shlex.join([*words, *options])
    print(f"interrupted; to continue: {command}", file=sys.stderr, flush=True)


def _repeat(otherwise: Callable[[Any], None], ignored: Any) -> None:
    """Send the signal again if Python ignored its exception, as in callbacks of the collector."""
    if ignored.exc_type is not KeyboardInterrupt:
        otherwise(ignored)
        return
    again = threading.Timer(AGAIN_S, os.kill, (os.getpid(), signal.SIGINT))
    again.daemon = True
    again.start()


def _has_results(folder: Path) -> bool:
    """Return True if a folder has a file that was not only prepared."""
    return any(
        not name.startswith(".") and name not in PREPARED
        for _, _, names in os.walk(folder)
        for name in names
    )


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise `KeyboardInterrupt`; exit during an import: half-imported libraries may crash."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            print_interrupted()
            os._exit(CODE)
        frame = frame.f_back
    raise KeyboardInterrupt
