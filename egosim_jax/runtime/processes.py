"""Worker processes that do not inherit the parent's state, and memory of a process with threads."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

T = TypeVar("T")
THREADS = "OPENBLAS_NUM_THREADS"
"""Environment variable that OpenBLAS reads when it is imported."""
M_MMAP_THRESHOLD, MMAP_THRESHOLD = -3, 1 << 20
"""Option of mallopt, and size in bytes from which glibc returns a block as soon as it is freed."""


def run_in_processes(
    run: Callable[..., T], calls: Sequence[tuple[Any, ...]], *, workers: int
) -> Iterator[tuple[int, T]]:
    """Yield the number and the result of each call as it finishes.

    After an error or Ctrl-C, calls that have not started are canceled. Raises `BrokenProcessPool`
    if a worker process was killed.
    """
    context = multiprocessing.get_context("spawn")  # a forked jax or Open3D may hang
    pool = ProcessPoolExecutor(max(1, min(workers, len(calls))), mp_context=context)
    try:
        with _ctrl_c_ignored(), _one_thread_each():
            tasks = {pool.submit(run, *call): number for number, call in enumerate(calls)}
        for task in as_completed(tasks):
            yield tasks[task], task.result()
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Give child processes that start in this context one OpenBLAS thread, unless it is set.

    If each process has a thread per core, two processes take twice as long.
    """
    if THREADS in os.environ:
        yield
        return
    os.environ[THREADS] = "1"
    try:
        yield
    finally:
        del os.environ[THREADS]


@contextmanager
def _ctrl_c_ignored() -> Iterator[None]:
    """Make child processes that start in this context ignore Ctrl-C; the parent stops them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def return_freed_blocks() -> None:
    """Make this process return large freed blocks to the system; only glibc needs it.

    glibc raises the threshold to the largest freed block, up to 32 MiB. Blocks below it then stay
    in the arena of their thread, and a server has many threads.
    """
    with suppress(AttributeError):  # another C library
        if sys.platform == "linux":
            ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, MMAP_THRESHOLD)
