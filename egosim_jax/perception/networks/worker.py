"""Worker processes that run networks: started, fed and ended by the calling process.

The calling process never imports torch, whose memory and libraries would conflict with jax. A
socket carries messages: a JSON value, then arrays as npz without pickle. A worker starts at its
first request and keeps its network loaded. It ends when its socket closes, and so also when its
parent is killed. `child` is its program.
"""

from __future__ import annotations

import atexit
import io
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.runtime.command import CommandExit, ExitCode
from egosim_jax.types import InputError

MAX_TAIL_LINES, MAX_TAIL_BYTES = 12, 4096
"""Maximum lines and bytes of a worker's error output in a message."""
ENVIRONMENT = {
    "HF_HUB_OFFLINE": "1",
    "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    "TRANSFORMERS_VERBOSITY": "error",
    "TOKENIZERS_PARALLELISM": "false",
}
"""Environment variables of a worker: it downloads neither weights nor code."""

Arrays = Mapping[str, np.ndarray]
Run = Callable[[Arrays, Mapping[str, Any]], tuple[Arrays, Any]]
"""Network that a module's `load` returns: maps arrays and options to arrays and a JSON value."""


class NetworkError(CommandExit):
    """Failure of a worker process: it died or timed out, or its network failed."""

    def __init__(self, message: str):
        super().__init__(message, ExitCode.FAILED)


def send(connection: Connection, value: Any, arrays: Arrays) -> None:
    """Send a JSON value and arrays to the other process."""
    packed, content = io.BytesIO(), dict[str, Any](arrays)
    np.savez(packed, **content)
    connection.send_bytes(json.dumps(value).encode())
    connection.send_bytes(packed.getbuffer())


def receive(connection: Connection) -> tuple[Any, dict[str, np.ndarray]]:
    """Return the next value and arrays. Raises `OSError` or `EOFError` if the socket is closed."""
    value = json.loads(connection.recv_bytes())
    with np.load(io.BytesIO(connection.recv_bytes()), allow_pickle=False) as content:
        return value, dict(content)


class Worker:
    """One child process that runs one network."""

    def __init__(self, module: str, settings: Mapping[str, Any]):
        """Store the module whose function `load` the child calls with the settings."""
        self._module, self._settings = module, dict(settings)
        self._lock = threading.Lock()
        self._child: _Child | None = None

    def __call__(
        self, arrays: Arrays, options: Mapping[str, Any], *, timeout_s: float
    ) -> tuple[dict[str, np.ndarray], Any]:
        """Return the arrays and the JSON value of a network's reply; start the worker if needed.

        Raises `InputError` if the worker refuses the request. Raises `NetworkError` if it dies,
        fails, or takes longer than `timeout_s`, loading included; the next call then starts a new
        worker.
        """
        with self._lock:
            deadline = time.monotonic() + timeout_s
            if self._child is None or not self._child.is_alive():
                self._end()
                self._child = _Child(self._module)
            child = self._child
            try:
                if not child.loaded:
                    child.exchange(self._settings, {}, deadline)
                    child.loaded = True
                return child.exchange(dict(options), arrays, deadline)
            except BaseException as error:
                if not (child.loaded and isinstance(error, InputError)):
                    self._end()  # after a refusal, it is ready for the next request
                if isinstance(error, TimeoutError):
                    raise NetworkError(
                        f"{self._module.rpartition('.')[2]} did not finish in {timeout_s:g} s: its "
                        "worker process was ended. Allow more time (--timeout-s), or use a GPU "
                        "(--device cuda:0)."
                    ) from None
                raise

    def close(self) -> None:
        """End the worker process."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.end()


class _Child:
    """A running child process and its socket."""

    def __init__(self, module: str):
        self._name = module.rpartition(".")[2]
        self.loaded = False
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        paths = [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")]
        variables = {**ENVIRONMENT, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
        ours, theirs = socket.socketpair()
        with theirs:
            program = ["-m", "egosim_jax.perception.networks.child", module, str(theirs.fileno())]
            self._process = subprocess.Popen(  # noqa: S603 - this package's module
                [sys.executable, "-P", *program],
                stdin=subprocess.DEVNULL,
                stdout=self._errors,  # with the output of libraries
                stderr=self._errors,
                env={**os.environ, **variables},
                pass_fds=[theirs.fileno()],
                process_group=0,  # Ctrl-C in a terminal is for the parent alone
            )
        self._connection = Connection(ours.detach())

    def is_alive(self) -> bool:
        return self._process.poll() is None

    def exchange(
        self, value: Any, arrays: Arrays, deadline: float
    ) -> tuple[dict[str, np.ndarray], Any]:
        """Send a request and return the arrays and the value of its reply."""
        try:
            send(self._connection, value, arrays)
            if not self._connection.poll(max(0.0, deadline - time.monotonic())):
                raise TimeoutError
            reply, result = receive(self._connection)
        except (EOFError, ConnectionError):
            raise self._death() from None
        if "value" in reply:
            return result, reply["value"]
        if reply["refused"]:
            raise InputError(reply["error"])
        raise NetworkError(f"{self._name} failed in its worker process: {reply['error']}")

    def end(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.wait()
        self._connection.close()
        self._errors.close()

    def _death(self) -> NetworkError:
        """Return the error for a closed socket, with the end of the process's error output."""
        try:
            code = self._process.wait(5)
        except subprocess.TimeoutExpired:
            code = None
        how = f"signal {-code}" if code and code < 0 else f"exit code {code}"
        hint = " It may have run out of memory." if code == -9 else ""
        self._errors.seek(max(0, self._errors.seek(0, os.SEEK_END) - MAX_TAIL_BYTES))
        lines = self._errors.read().decode("utf-8", "replace").splitlines()[-MAX_TAIL_LINES:]
        tail = "\n".join("".join(c for c in line if c.isprintable()) for line in lines)
        return NetworkError(
            f"{self._name}: the worker process ended during a request ({how}).{hint} Its last "
            f"lines:\n{tail or '(none)'}"
        )


_WORKERS: dict[tuple[int, str, str], Worker] = {}
"""Workers by process id, module and settings; a forked process does not use its parent's."""


def worker_of(module: str, settings: Mapping[str, Any]) -> Worker:
    """Return this process's worker for a module and its settings."""
    key = os.getpid(), module, json.dumps(settings, sort_keys=True)
    return _WORKERS.setdefault(key, Worker(module, settings))


def close_workers() -> None:
    """End all workers of this process, which frees their memory."""
    for key in [key for key in _WORKERS if key[0] == os.getpid()]:
        _WORKERS.pop(key).close()


atexit.register(close_workers)
