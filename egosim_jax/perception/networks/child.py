"""Program of a worker process: load one network, then serve requests until the pipe closes."""

from __future__ import annotations

import importlib
import json
import os
import queue
import shutil
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from egosim_jax.types import InputError

Run = Callable[[Mapping[str, np.ndarray], Mapping[str, Any]], tuple[Mapping[str, np.ndarray], Any]]
"""Network returned by `load`: maps arrays and options to arrays and a JSON value."""


def main() -> None:
    """Serve the parent process."""
    replies = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # output of libraries must not become a reply
    requests = _requests()
    start = next(requests)
    folder = Path(start["folder"])
    module = importlib.import_module(sys.argv[1])
    run = _guarded(replies, lambda: (module.load(**start["settings"]), None))
    if run is None:
        return
    for request in requests:

        def serve(request: Mapping[str, Any] = request) -> tuple[None, Any]:
            with np.load(folder / "request.npz", allow_pickle=False) as found:
                arrays = {name: found[name] for name in found.files}
            arrays, value = run(arrays, request["options"])
            np.savez(folder / "reply.npz", **arrays)
            return None, value

        _guarded(replies, serve)


def _requests() -> Iterator[dict[str, Any]]:
    """Yield the parent's requests; end the process at once when the pipe closes."""
    lines: queue.Queue[bytes] = queue.Queue()
    first = sys.stdin.buffer.readline()
    folder = json.loads(first)["folder"]

    def read() -> None:
        for line in sys.stdin.buffer:
            lines.put(line)
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(0)  # the parent is gone: a running network must not continue

    threading.Thread(target=read, daemon=True).start()
    yield json.loads(first)
    while True:
        yield json.loads(lines.get())


def _guarded(replies: TextIO, work: Callable[[], tuple[Any, Any]]) -> Any:
    """Run `work`, reply with its value or its failure, and return its result."""
    result, reply = None, {}
    try:
        result, reply["value"] = work()
    except InputError as error:
        reply = {"error": str(error), "refused": True}
    except Exception as error:
        traceback.print_exc()
        reply = {"error": _summary(error), "refused": False}
    replies.write(json.dumps(reply) + "\n")
    replies.flush()
    return result


def _summary(error: Exception) -> str:
    text = f"{type(error).__name__}: {error}"[:2000]
    if "out of memory" in text:
        text += (
            "\nUse another device (--device cuda:1) or --dtype bfloat16, or leave memory to the "
            "worker (XLA_PYTHON_CLIENT_MEM_FRACTION)."
        )
    return text


if __name__ == "__main__":
    main()
