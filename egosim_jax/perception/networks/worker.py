"""Worker processes that run networks: started, fed and ended by the calling process.

The calling process never imports torch, whose memory and libraries would conflict with jax.
Requests and replies are lines of JSON over pipes. Arrays are npz files without pickle in a private
temporary folder. A worker starts at its first request and keeps its network loaded. It ends when
its pipe closes, and so also when its parent is killed.
"""

from __future__ import annotations

import atexit
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from egosim_jax.io.untrusted.npz import read_all
from egosim_jax.runtime.command import CommandExit, ExitCode
from egosim_jax.types import InputError

MAX_TAIL_LINES, MAX_TAIL_BYTES = 12, 4096
"""Maximum lines and bytes of a worker's error output in a message."""
MAX_REPLY_BYTES = 1 << 20
"""Maximum size of a reply in bytes, without its arrays."""
ENVIRONMENT = {
    "HF_HUB_OFFLINE": "1",
    "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    "TRANSFORMERS_VERBOSITY": "error",
    "TOKENIZERS_PARALLELISM": "false",
}
"""Environment variables of a worker: it downloads neither weights nor code."""

Arrays = Mapping[str, np.ndarray]


class NetworkError(CommandExit):
    """Failure of a worker process: it died or timed out, or its network failed."""

    def __init__(self, message: str):
        super().__init__(message, ExitCode.FAILED)


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
            try:
                child = self._running(deadline)
                request: dict[str, Any] = dict(arrays)
                np.savez(child.folder / "request.npz", **request)
                value = child.exchange({"options": dict(options)}, deadline)
                return read_all(child.folder / "reply.npz"), value
            except InputError:
                raise  # the worker is ready for the next request
            except TimeoutError:
                self._end()
                raise NetworkError(
                    f"{self._module.rpartition('.')[2]} did not finish in {timeout_s:g} s: its "
                    "worker process was ended. Allow more time (--timeout-s), or use a GPU "
                    "(--device cuda:0)."
                ) from None
            except BaseException:
                self._end()
                raise

    def close(self) -> None:
        """End the worker process and remove its files."""
        with self._lock:
            self._end()

    def _running(self, deadline: float) -> _Child:
        """Return the child process. Start it and load its network if it is not alive."""
        if self._child is None or not self._child.is_alive():
            self._end()
            self._child = _Child(self._module)
            try:
                self._child.exchange(
                    {"settings": self._settings, "folder": str(self._child.folder)}, deadline
                )
            except InputError:
                self._end()
                raise
        return self._child

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.end()


class _Child:
    """A running child process, its pipes and its folder."""

    def __init__(self, module: str):
        self._name = module.rpartition(".")[2]
        self.folder = Path(tempfile.mkdtemp(prefix="egosim-network-"))
        paths = [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")]
        variables = {**ENVIRONMENT, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
        with (self.folder / "stderr").open("wb") as errors:
            self._process = subprocess.Popen(  # noqa: S603 - this package's module
                [sys.executable, "-P", "-m", "egosim_jax.perception.networks.child", module],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env={**os.environ, **variables},
                process_group=0,  # Ctrl-C in a terminal is for the parent alone
            )
        self._requests = cast(IO[bytes], self._process.stdin)
        self._replies = cast(IO[bytes], self._process.stdout)
        self._unread = b""

    def is_alive(self) -> bool:
        return self._process.poll() is None

    def exchange(self, request: Mapping[str, Any], deadline: float) -> Any:
        """Send a request and return the value of its reply."""
        try:
            self._requests.write(json.dumps(request).encode() + b"\n")
            self._requests.flush()
        except BrokenPipeError:
            raise self._death() from None
        reply = json.loads(self._read_line(deadline))
        if "value" in reply:
            return reply["value"]
        if reply["refused"]:
            raise InputError(reply["error"])
        raise NetworkError(f"{self._name} failed in its worker process: {reply['error']}")

    def end(self) -> None:
        """Kill the process and remove its folder."""
        self._process.kill()
        self._process.wait()
        with suppress(BrokenPipeError):
            self._requests.close()
        self._replies.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _read_line(self, deadline: float) -> bytes:
        descriptor = self._replies.fileno()
        while b"\n" not in self._unread:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([descriptor], [], [], left)[0]:
                raise TimeoutError
            data = os.read(descriptor, 1 << 16)
            if not data or len(self._unread) > MAX_REPLY_BYTES:
                raise self._death()
            self._unread += data
        line, _, self._unread = self._unread.partition(b"\n")
        return line

    def _death(self) -> NetworkError:
        """Return the error for a closed pipe, with the end of the process's error output."""
        try:
            code = self._process.wait(5)
        except subprocess.TimeoutExpired:
            code = None
        how = f"signal {-code}" if code and code < 0 else f"exit code {code}"
        hint = " It may have run out of memory." if code == -9 else ""
        with (self.folder / "stderr").open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - MAX_TAIL_BYTES))
            lines = file.read().decode("utf-8", "replace").splitlines()[-MAX_TAIL_LINES:]
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
