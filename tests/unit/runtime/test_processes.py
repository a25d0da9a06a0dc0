"""Calls in worker processes, and memory that threads have freed."""

import os
import subprocess
import sys

import pytest

from egosim_jax.runtime.processes import THREADS, run_in_processes


def test_workers_have_one_thread_and_the_parent_keeps_its_own(monkeypatch):
    monkeypatch.delenv(THREADS, raising=False)
    found = dict(run_in_processes(os.getenv, [(THREADS,), ("EGOSIM_UNSET", "none")], workers=2))
    assert found == {0: "1", 1: "none"}
    assert THREADS not in os.environ


PROGRAM = """
import ctypes, threading
from egosim_jax.runtime.processes import return_freed_blocks
return_freed_blocks()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 >> 20

def work():
    for size in range(4, 24, 2):
        blocks = [libc.malloc(size << 20) for _ in range(2)]
        small = libc.malloc(100)
        for block in blocks:
            ctypes.memset(block, 1, size << 20)
        for block in blocks:
            libc.free(block)

before = resident()
threads = [threading.Thread(target=work) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(resident() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc keeps freed blocks")
def test_large_blocks_of_threads_are_returned():
    command = [sys.executable, "-c", PROGRAM]
    found = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert int(found.stdout) < 16
