"""Ctrl-C, at any time: one line that says how to go on, also while a program is being imported."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType


def expect() -> None:
    """Be ready for Ctrl-C; a program calls this before it imports anything large."""
    with suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, _end)


@contextmanager
def not_inherited() -> Iterator[None]:
    """Let the processes that are started meanwhile ignore Ctrl-C, which reaches them, too."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def tell() -> None:
    """Say how to go on."""
    print(f"interrupted; to continue: {shlex.join(sys.argv)}", file=sys.stderr, flush=True)


def _end(number: int, frame: FrameType | None) -> None:
    """Raise `KeyboardInterrupt`, unless within an import: a library cut off there may crash."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            tell()
            os._exit(1)
        frame = frame.f_back
    raise KeyboardInterrupt
