"""Calls of functions in a child process that may crash, hang or run out of memory there.

Libraries in C and C++ loop, abort or allocate without end on damaged files. A child runs call after
call. After a crash or the time limit it is killed, and the next call starts another one.

This is not a pool of `multiprocessing`: only private attributes end a worker that hangs, a worker
outlives a parent that is killed, and it imports the parent's main module (if that imports OpenCV,
pycolmap crashes). A pool's first and later calls are no faster.
"""

from __future__ import annotations

import atexit
import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import IO, Any, NoReturn, TypeVar

from egosim_jax.io.bounded import check_inside, quote_path, quote_text
from egosim_jax.runtime.processes import THREADS
from egosim_jax.types import InputError

T = TypeVar("T")
TIMEOUT_S = 120.0
"""Time limit for a file in seconds, with the start of the child."""
MAX_CPU_S = 15.0
"""Maximum processor time that a file takes, in seconds."""
MAX_MEMORY = 9 << 26
"""Maximum size of the child's data while it reads a file, in bytes; about 150 MB are libraries."""
MAX_ADDRESSES = 1 << 32
"""Maximum address space of the child that reads files, in bytes."""
MAX_REPLY = 1 << 30
"""Maximum size of a result in bytes."""


class ChildError(RuntimeError):
    """Raised when a child process ends during a call; says how, with its last lines."""


class Child:
    """A child process that runs functions; the first call starts it."""

    def __init__(
        self,
        *,
        max_memory: int | None = None,
        max_reply: int | None = MAX_REPLY,
        tail_lines: int = 1,
    ) -> None:
        self._max_memory, self._max_reply = max_memory, max_reply
        self._tail_lines = tail_lines  # of its error output, in the message of a `ChildError`
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection
        self._log: IO[bytes]
        self._owner = os.getpid()
        self._lock = threading.Lock()

    def call(self, run: Callable[..., T], *arguments: Any, timeout_s: float) -> T:
        """Return the result of a function that the child can import.

        Raises `TimeoutError` after the time limit, which it names, or after the processor time,
        `ChildError` after a crash, and `InputError` or `MemoryError` if the function does. Its
        other exceptions end the child.
        """
        with self._lock:
            process = self._start()
            try:
                self._connection.send((run, arguments))
                if self._connection.poll(timeout_s):
                    # A child that a file took over has the user's rights: pickle adds none.
                    result = pickle.loads(self._connection.recv_bytes(self._max_reply))  # noqa: S301
                else:
                    self.close()
                    result = TimeoutError(f"{timeout_s:g} s")
            except (EOFError, OSError) as error:
                ending = self._ending(process)
                if process.returncode == -signal.SIGPROF:  # its processor time is over
                    raise TimeoutError from error
                raise ChildError(ending) from error
            except BaseException:  # Ctrl-C leaves a reply unread
                self.close()
                raise
        if isinstance(result, (InputError, MemoryError, TimeoutError)):
            raise result
        return result

    def close(self) -> None:
        """Kill the child, if there is one, and the processes that it started."""
        process, self._process = self._process, None
        if process is not None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            self._connection.close()
            self._log.close()

    def _start(self) -> subprocess.Popen[bytes]:
        """Return the child, which is started unless it runs."""
        if self._owner != os.getpid():  # after a fork, the child belongs to another process
            self._process, self._owner = None, os.getpid()
        if self._process is not None and self._process.poll() is None:
            return self._process
        self.close()
        paths = [str(Path(__file__).parents[3]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
        if self._max_memory is not None:
            environment[THREADS] = "1"  # stacks of more threads would count as memory
        self._connection, other = Pipe()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        with other:
            program = f"from {__name__} import serve; serve({other.fileno()}, {self._max_memory})"
            self._process = subprocess.Popen(  # noqa: S603
                [sys.executable, "-P", "-c", program],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._log,
                pass_fds=[other.fileno()],
                start_new_session=True,
                env=environment,
            )
        return self._process

    def _ending(self, process: subprocess.Popen[bytes]) -> str:
        """Close the child; return how it ended and the last lines that it printed."""
        with suppress(subprocess.TimeoutExpired):
            process.wait(1.0)  # a connection closes a moment before its process ends
        self._log.seek(max(0, self._log.seek(0, os.SEEK_END) - 20_000))
        lines = self._log.read().decode("utf-8", "replace").splitlines()
        # Lines that begin with @ are a stack of glog's.
        lines = [line.strip() for line in lines if line.strip() and not line.startswith("    @")]
        self.close()
        code = process.returncode
        how = f"failed with exit code {code}" if code >= 0 else f"was ended by signal {-code}"
        with suppress(ValueError):
            how = f"was ended by {signal.Signals(-code).name}"
        shown = ("".join(filter(str.isprintable, line)) for line in lines[-self._tail_lines :])
        tail = "\n".join(line[:300] for line in shown)
        return f"{how}: {tail or 'no message'}"


def read_file(
    read: Callable[..., T],
    path: Path,
    *arguments: Any,
    max_memory: int | None = None,
    max_cpu_s: float | None = None,
) -> T:
    """Return the result of a function that reads an untrusted file, called in a child process.

    Raises `InputError` if it crashes, hangs, or takes more memory or processor time than allowed:
    by default `MAX_MEMORY` and `MAX_CPU_S`.
    """
    check_inside(path)
    name = quote_path(path)
    max_memory, max_cpu_s = max_memory or MAX_MEMORY, max_cpu_s or MAX_CPU_S
    try:
        if max_memory > MAX_MEMORY:
            _GROWN.set()
        elif _GROWN.is_set():  # what the child keeps of more memory, this file would lack
            _READER.close()
            _GROWN.clear()
        return _READER.call(
            _limited, max_memory, max_cpu_s, read, path, *arguments, timeout_s=TIMEOUT_S
        )
    except TimeoutError as error:
        limit = str(error) or f"{max_cpu_s:g} s of processor time"
        raise InputError(
            f"{name} could not be read within {limit}: the library hangs on it. It is damaged or "
            "too large. Get it again, or split it."
        ) from None
    except MemoryError:
        _READER.close()
        raise InputError(
            f"{name} needs more memory than {max_memory:,} bytes, the maximum: it is damaged or "
            "too large. Get it again, or split it."
        ) from None
    except ChildError as error:
        raise InputError(
            f"{name} made the library that reads it crash, which {quote_text(str(error))}. It is "
            "damaged; get it again."
        ) from error


def _limited(max_memory: int, max_cpu_s: float, read: Callable[..., T], *arguments: Any) -> T:
    """Call a function with limits of memory and processor time; this runs in the child.

    The kernel refuses what would exceed the memory, and ends the child when its time is over.
    """
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    soft = max_memory if hard == resource.RLIM_INFINITY else min(max_memory, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
    signal.setitimer(signal.ITIMER_PROF, max_cpu_s)
    try:
        return read(*arguments)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def serve(descriptor: int, max_memory: int | None) -> NoReturn:
    """Run the calls of the parent and return their results; this runs in the child."""
    if max_memory is not None:
        resource.setrlimit(resource.RLIMIT_AS, (max_memory, max_memory))
    connection, calls = Connection(descriptor), SimpleQueue[bytes]()
    threading.Thread(target=_receive, args=(connection, calls), daemon=True).start()
    while True:
        run, arguments = pickle.loads(calls.get())  # noqa: S301
        try:
            reply = pickle.dumps(run(*arguments))
        except InputError as error:
            reply = pickle.dumps(error)
        except MemoryError:
            reply = pickle.dumps(MemoryError())
        connection.send_bytes(reply)
        del reply


def _receive(connection: Connection, calls: SimpleQueue[bytes]) -> None:
    """Queue calls; end the child as soon as the parent ends, even during a call."""
    with suppress(EOFError, OSError):
        while True:
            calls.put(connection.recv_bytes())
    os._exit(1)


_READER, _GROWN = Child(max_memory=MAX_ADDRESSES), threading.Event()
atexit.register(_READER.close)
