"""Ctrl-C at any time: print one line with the command that continues.

A program imports this module and calls `expect` before its large imports, which take seconds. So it
imports only the standard library, and is not part of `command.py`.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
from contextlib import suppress
from types import FrameType


def expect() -> None:
    """Install the handler of Ctrl-C."""
    with suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, _interrupt)


def ignore() -> None:
    """Ignore Ctrl-C, once the work is done."""
    with suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def print_how_to_continue() -> None:
    """Print the command line that continues an interrupted run."""
    program, *options = sys.argv
    # `egosim train` is a program of two words (`cli/__main__.py`); others are paths.
    words = [program] if os.sep in program else program.split()
    command = shlex.join([*words, *options])
    print(f"interrupted; to continue: {command}", file=sys.stderr, flush=True)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise `KeyboardInterrupt`; exit during an import: half-imported libraries may crash."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            print_how_to_continue()
            os._exit(1)
        frame = frame.f_back
    raise KeyboardInterrupt
