"""Program of a worker process: load one network, then serve requests until the socket closes."""

from __future__ import annotations

import importlib
import os
import queue
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from egosim_jax.perception.networks.worker import Run, receive, send
from egosim_jax.types import InputError


def main(module: str, descriptor: int) -> None:
    """Serve the parent process."""
    os.set_inheritable(descriptor, False)
    connection = Connection(descriptor)
    requests: queue.Queue[tuple[Any, dict[str, np.ndarray]]] = queue.Queue()

    def read() -> None:
        try:
            while True:
                requests.put(receive(connection))
        finally:
            os._exit(0)  # the parent is gone: a running network must not continue

    threading.Thread(target=read, daemon=True).start()
    settings, _ = requests.get()
    run: Run | None = None

    def load() -> tuple[Mapping[str, np.ndarray], Any]:
        nonlocal run
        run = importlib.import_module(module).load(**settings)
        return {}, None

    _reply(connection, load)
    while run is not None:
        options, arrays = requests.get()
        _reply(connection, partial(run, arrays, options))


def _reply(connection: Connection, work: Callable[[], tuple[Mapping[str, Any], Any]]) -> None:
    """Reply with the result of `work`, or with its failure."""
    arrays: Mapping[str, np.ndarray] = {}
    try:
        arrays, value = work()
        reply = {"value": value}
    except InputError as error:
        reply = {"error": str(error), "refused": True}
    except Exception as error:
        traceback.print_exc()
        reply = {"error": _summary(error), "refused": False}
    send(connection, reply, arrays)


def _summary(error: Exception) -> str:
    text = f"{type(error).__name__}: {error}"[:2000]
    if "out of memory" in text:
        text += (
            "\nUse another device (--device cuda:1) or --dtype bfloat16, or leave memory to the "
            "worker (XLA_PYTHON_CLIENT_MEM_FRACTION)."
        )
    return text


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
