"""Files of HDF5 and Parquet, read in a child process, of which no crash and no hang reaches us.

Their libraries are large, written in C and C++, and damaged files make them loop or abort the
process. One child (`isolated_child.py`) reads file after file; it is ended after a time limit and
started again for the next file. What it sends back is JSON and plain numbers, checked here.
"""

from __future__ import annotations

import atexit
import json
import os
import selectors
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast, no_type_check

import numpy as np
from jaxtyping import Float64

from egosim_jax.io.bounded import quote_path
from egosim_jax.types import InputError

Shape = tuple[int | None, ...]
"""Sizes of the axes of an array; None is any size."""
TIMEOUT_S = 120.0
"""Time limit for a file in seconds, with the start of the child."""
MAX_REPLY = 1 << 31
"""Largest reply in bytes."""
CHILD = Path(__file__).with_name("isolated_child.py")


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Hdf5Contents:
    """Arrays and texts that were read of an HDF5 file."""

    arrays: Mapping[str, Float64[np.ndarray, ...]]
    """Arrays of the file by their path in it."""
    texts: Mapping[str, tuple[str, ...]]
    """Texts of attributes of the file by name; none of an attribute that is absent."""


def read_hdf5(
    path: Path,
    arrays: Mapping[str, Shape],
    *,
    optional: Mapping[str, Shape] | None = None,
    texts: Sequence[str] = (),
) -> Hdf5Contents:
    """Read arrays of numbers and attributes of text of an HDF5 file (`hdf5.Hdf5`).

    `arrays` gives the shapes of those that must exist. Raises `InputError` for what is missing, of
    another shape, not in the file itself, too large or damaged.
    """
    header, data = _CHILD.ask(
        path,
        {
            "kind": "hdf5",
            "path": str(path),
            "arrays": {name: list(shape) for name, shape in arrays.items()},
            "optional": {name: list(shape) for name, shape in (optional or {}).items()},
            "texts": list(texts),
        },
    )
    found, start = {}, 0
    for name, shape in header["arrays"]:
        count = int(np.prod(shape, dtype=np.int64))
        found[name] = np.frombuffer(data, np.float64, count=count, offset=start).reshape(shape)
        start += 8 * count
    return Hdf5Contents(
        arrays={name: array.copy() for name, array in found.items()},
        texts={name: tuple(values) for name, values in header["texts"].items()},
    )


def read_parquet(
    path: Path, columns: Sequence[str], *, optional: Sequence[str] = ()
) -> dict[str, list[Any]]:
    """Read columns of a Parquet file as Python values (`parquet.read_columns`)."""
    request = {"kind": "parquet", "path": str(path), "columns": list(columns),
               "optional": list(optional)}  # fmt: skip
    return _CHILD.ask(path, request)[0]["columns"]


class _Child:
    """The child process, which is started when it is first needed."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = os.getpid()
        self._lock = threading.Lock()

    def ask(self, path: Path, request: Mapping[str, Any]) -> tuple[dict[str, Any], bytes]:
        """Send a request; return the header and the bytes of the reply."""
        with self._lock:
            deadline = time.monotonic() + TIMEOUT_S
            requests, replies = self._pipes()
            try:
                requests.write(json.dumps(request).encode() + b"\n")
                requests.flush()
                sizes = self._read(replies, 16, deadline)
                head, body = (int.from_bytes(sizes[i : i + 8], "little") for i in (0, 8))
                if head + body > MAX_REPLY:
                    raise OSError(f"the reply has {head + body:,} bytes")
                data = self._read(replies, head + body, deadline)
            except TimeoutError:
                self.stop()
                raise InputError(
                    f"{quote_path(path)} could not be read within {TIMEOUT_S:g} s: the library "
                    "hangs on it. It is damaged; get it again."
                ) from None
            except OSError as error:
                self.stop()
                raise InputError(
                    f"{quote_path(path)} made the library that reads it crash. It is damaged; get "
                    "it again."
                ) from error
            except BaseException:  # an interrupt leaves a reply unread
                self.stop()
                raise
        header = json.loads(data[:head])
        if "error" in header:
            raise InputError(header["error"])
        return header, data[head:]

    def stop(self) -> None:
        """End the child, if there is one."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                with suppress(OSError):
                    if pipe is not None:
                        pipe.close()

    def _pipes(self) -> tuple[IO[bytes], IO[bytes]]:
        """Return input and output of the child, which is started unless it runs."""
        if self._owner != os.getpid():  # after a fork the child is that of another process
            self._process, self._owner = None, os.getpid()
        if self._process is None or self._process.poll() is not None:
            self.stop()
            package = str(CHILD.parents[3])
            paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
            self._process = subprocess.Popen(  # noqa: S603
                [sys.executable, "-P", str(CHILD)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            )
        pipes = self._process.stdin, self._process.stdout
        return cast(tuple[IO[bytes], IO[bytes]], pipes)

    @staticmethod
    def _read(replies: IO[bytes], count: int, deadline: float) -> bytes:
        """Read so many bytes before the deadline. Raises `OSError` if the child ends before."""
        parts, left, descriptor = list[bytes](), count, replies.fileno()
        with selectors.DefaultSelector() as selector:
            selector.register(descriptor, selectors.EVENT_READ)
            while left:
                if not selector.select(max(0.0, deadline - time.monotonic())):
                    raise TimeoutError
                part = os.read(descriptor, min(left, 1 << 20))
                if not part:
                    raise OSError("the child ended")
                parts.append(part)
                left -= len(part)
        return b"".join(parts)


_CHILD = _Child()
atexit.register(_CHILD.stop)
