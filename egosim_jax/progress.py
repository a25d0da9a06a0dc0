"""Progress on stderr: a live line on a terminal, plain lines otherwise."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

PLAIN_SECONDS = 10.0
"""At most one plain line in so many seconds."""


def track(items: Iterable[T], verb: str, *, total: int) -> Iterator[T]:
    """Pass the items on, showing how many of `total` are done."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import track as live

        yield from live(items, verb, total=total, console=Console(stderr=True), transient=True)
        return
    then = time.monotonic()
    for done, item in enumerate(items, start=1):
        yield item
        if done == total or time.monotonic() - then > PLAIN_SECONDS:
            then = time.monotonic()
            print(f"{verb}: {done}/{total}", file=sys.stderr, flush=True)
