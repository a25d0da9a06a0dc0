"""SIGTERM, the signal of a scheduler that will soon end a process.

A program calls `expect` before its large imports, and enters `noting` for the work that can be
saved. So this module imports only the standard library, like `interrupts.py`.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

CODE = 75
"""Exit code of a command that is to be run again."""
_noted = threading.Event()


def expect() -> None:
    """Make SIGTERM end the process with `CODE`: it has made nothing yet."""
    signal.signal(signal.SIGTERM, _end)


@contextmanager
def noting() -> Iterator[None]:
    """Note SIGTERM in this context, where the work asks `is_noted` and stops by itself.

    Outside of the main thread, which has all signals, it does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda *_: _noted.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
        _noted.clear()


def is_noted() -> bool:
    """Return True once this process got SIGTERM in the context `noting`."""
    return _noted.is_set()


def _end(*_: Any) -> None:
    os.write(2, b"stopped; run the same command again\n")
    os._exit(CODE)
