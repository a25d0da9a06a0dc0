"""Progress on stderr: a live line on a terminal, plain lines otherwise."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

PLAIN_SECONDS = 5.0
"""Minimum time between two plain lines, in seconds."""


def track(items: Iterable[T], verb: str, *, total: int) -> Iterator[T]:
    """Yield the items while showing how many of `total` are done."""
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


def track_bytes(sizes: Iterable[int], verb: str, *, total: int) -> Iterator[int]:
    """Yield sizes in bytes while showing the bytes done, the speed and the time left."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            DownloadColumn,
            Progress,
            TextColumn,
            TimeRemainingColumn,
            TransferSpeedColumn,
        )

        columns = (
            TextColumn("{task.description}"), BarColumn(), DownloadColumn(),
            TransferSpeedColumn(), TimeRemainingColumn(),
        )  # fmt: skip
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task(verb, total=total)
            for size in sizes:
                progress.advance(task, size)
                yield size
        return
    start = then = time.monotonic()
    done = 0
    for size in sizes:
        done += size
        yield size
        now = time.monotonic()
        if done == total or now - then > PLAIN_SECONDS:
            then = now
            speed = max(done / max(now - start, 1e-9), 1.0)
            print(
                f"{verb}: {done / 1e9:.2f}/{total / 1e9:.2f} GB, {speed / 1e9:.2f} GB/s, "
                f"{(total - done) / speed:.0f} s left",
                file=sys.stderr,
                flush=True,
            )
