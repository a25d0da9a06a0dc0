"""Worker processes that run networks: started, fed and ended by the calling process.

The calling process never imports torch, whose memory and libraries would conflict with jax. A
worker starts at its first request and keeps its network loaded. It ends with its parent, even if
that is killed (`io/untrusted/isolated.py`).
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from egosim_jax.io.untrusted.isolated import Child, ChildError
from egosim_jax.runtime.command import CommandExit, ExitCode
from egosim_jax.types import InputError

MAX_TAIL_LINES = 12
"""Maximum number of lines of a worker's error output in a message."""
ENVIRONMENT = {
    "HF_HUB_OFFLINE": "1",
    "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    "TRANSFORMERS_VERBOSITY": "error",
    "TOKENIZERS_PARALLELISM": "false",
}
"""Environment variables of a worker: it downloads neither weights nor code."""

Arrays = Mapping[str, np.ndarray]
Reply = tuple[dict[str, np.ndarray], Any]
Run = Callable[[Arrays, Mapping[str, Any]], tuple[Arrays, Any]]
"""Network that a module's `load` returns: maps arrays and options to arrays and a value."""


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
        self._child = Child(max_reply=None, tail_lines=MAX_TAIL_LINES)

    def __call__(self, arrays: Arrays, options: Mapping[str, Any], *, timeout_s: float) -> Reply:
        """Return the arrays and the value of a network's reply; start the worker if needed.

        Raises `InputError` if the worker refuses the request. Raises `NetworkError` if it dies,
        fails, or takes longer than `timeout_s`, loading included; the next call then starts a new
        worker.
        """
        name = self._module.rpartition(".")[2]
        request = self._module, self._settings, dict(arrays), dict(options)
        with self._lock:
            try:
                reply = self._child.call(answer, *request, timeout_s=timeout_s)
            except InputError:
                if not self._child.call(is_loaded, self._module, timeout_s=timeout_s):
                    self._child.close()  # it refused its folder or device, and is of no use
                raise
            except TimeoutError:
                raise NetworkError(
                    f"{name} did not finish in {timeout_s:g} s: its worker process was ended. "
                    "Allow more time (--timeout-s), or use a GPU (--device cuda:0)."
                ) from None
            except ChildError as error:
                hint = " It may have run out of memory." if "SIGKILL" in str(error) else ""
                raise NetworkError(
                    f"{name}: the worker process ended during a request.{hint} It {error}"
                ) from None
            if isinstance(reply, str):
                self._child.close()
                raise NetworkError(f"{name} failed in its worker process: {reply}")
        return reply

    def close(self) -> None:
        """End the worker process."""
        with self._lock:
            self._child.close()


_NETWORKS: dict[str, Run] = {}
"""Network of this process by its module, in a worker."""


def is_loaded(module: str) -> bool:
    """Return True in a worker that has loaded a network."""
    return module in _NETWORKS


def answer(
    module: str, settings: Mapping[str, Any], arrays: Arrays, options: Mapping[str, Any]
) -> Reply | str:
    """Return a network's reply, or its failure; this runs in the worker, which loads it once."""
    try:
        if module not in _NETWORKS:
            os.environ.update(ENVIRONMENT)
            _NETWORKS[module] = importlib.import_module(module).load(**settings)
        result, value = _NETWORKS[module](arrays, options)
        return dict(result), value
    except InputError:
        raise
    except Exception as error:
        text = f"{type(error).__name__}: {error}"[:2000]
        if "out of memory" in text:
            text += (
                "\nUse another device (--device cuda:1) or --dtype bfloat16, or leave memory to "
                "the worker (XLA_PYTHON_CLIENT_MEM_FRACTION)."
            )
        return text


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
