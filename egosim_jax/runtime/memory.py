"""Memory of long-running processes."""

from __future__ import annotations

import ctypes
import sys

MMAP_THRESHOLD = 1 << 20
"""Size in bytes from which a block of memory is returned to the system as soon as it is freed."""
_M_MMAP_THRESHOLD = -3


def return_freed_blocks() -> None:
    """Make this process return large freed blocks to the system; only glibc needs it.

    glibc raises the threshold to the largest freed block, up to 32 MiB. Blocks below it then stay
    in the arena of their thread, and a server has many threads.
    """
    if sys.platform == "linux":
        try:
            ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, MMAP_THRESHOLD)
        except AttributeError:  # another C library
            return
