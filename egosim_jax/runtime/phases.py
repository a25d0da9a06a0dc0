"""Phases of a command: what it loads, compiles and makes, on stderr while it happens.

Library code opens a `phase` around slow work. It prints only inside `show_phases`, which commands
and environments enter. A phase prints a line when it begins. If it lasts, a terminal shows a live
line with the time, and a log gets a line every `PLAIN_SECONDS`.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from egosim_jax.runtime.progress import PLAIN_SECONDS
from egosim_jax.runtime.terminal import printable

LIVE_SECONDS = 5.0
"""Age in seconds from which a phase has a live line on a terminal."""


class _Shown:
    """Number of open `show_phases`, and the open phases, of all threads."""

    depth = 0
    phases: list[object] = []  # noqa: RUF012 - one for the process
    lock = threading.Lock()


@contextmanager
def show_phases() -> Iterator[None]:
    """Show the phases of this process inside the context. For commands and environments."""
    with _Shown.lock:
        _Shown.depth += 1
    try:
        yield
    finally:
        with _Shown.lock:
            _Shown.depth -= 1


@contextmanager
def hide_phases() -> Iterator[None]:
    """Hide the phases of this process inside the context, where many at once would be noise."""
    with _Shown.lock:
        depth, _Shown.depth = _Shown.depth, 0
    try:
        yield
    finally:
        with _Shown.lock:
            _Shown.depth += depth


@contextmanager
def phase(text: str, *, only_if_long: bool = False) -> Iterator[None]:
    """Show a phase, if phases are shown, while the context is open.

    With `only_if_long` its first line waits until a live line or a repeated line is due.
    """
    if not _Shown.depth:
        yield
        return
    text = printable(text)
    if not only_if_long:
        print(text, file=sys.stderr, flush=True)
    ended = threading.Event()
    thread = threading.Thread(target=_watch, args=(text, ended), name="phase", daemon=True)
    with _Shown.lock:
        _Shown.phases.append(ended)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        with _Shown.lock:
            _Shown.phases.remove(ended)


def _watch(text: str, ended: threading.Event) -> None:
    """Show the time of a phase while it is the innermost one: in a live line, or in a log's."""
    since, live = time.monotonic(), sys.stderr.isatty()
    while not ended.wait(LIVE_SECONDS if live else PLAIN_SECONDS):
        with _Shown.lock:
            innermost = bool(_Shown.phases) and _Shown.phases[-1] is ended
        if innermost and live:
            _show_live(text, since, ended)
            return
        if innermost:
            print(f"{text}: {time.monotonic() - since:.0f} s", file=sys.stderr, flush=True)


def _show_live(text: str, since: float, ended: threading.Event) -> None:
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn

    # Not rich's own clock: the phase began before its live line.
    columns = SpinnerColumn(), TextColumn("{task.description}", markup=False)
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=False) as live:
        task = live.add_task(text)
        while True:
            live.update(task, description=f"{text}: {time.monotonic() - since:.0f} s")
            if ended.wait(0.5):
                return
