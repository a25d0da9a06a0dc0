"""Child process that reads HDF5 and Parquet files; see `isolated.py`.

Each line of its input is a request in JSON. Its output, for each, is the sizes of two parts as 8
bytes each, little-endian, and the parts: a header in JSON, and arrays of float64 one after the
other. It ends when its input does.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.untrusted.hdf5 import open_hdf5
from egosim_jax.io.untrusted.parquet import read_columns
from egosim_jax.types import InputError

MAX_MEMORY = 1 << 34
"""Largest address space of the process in bytes."""


def main() -> None:
    """Serve requests until the input ends."""
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not get between the parts
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, MAX_MEMORY))
    for line in sys.stdin.buffer:
        try:
            header, arrays = _read(json.loads(line))
        except InputError as error:
            header, arrays = {"error": str(error)}, []
        except MemoryError:
            header, arrays = {"error": "A file needs more memory than it may have."}, []
        head = json.dumps(header).encode()
        body = b"".join(np.ascontiguousarray(array, "<f8").tobytes() for array in arrays)
        output.write(len(head).to_bytes(8, "little") + len(body).to_bytes(8, "little"))
        output.write(head + body)
        output.flush()


def _read(request: dict[str, Any]) -> tuple[dict[str, Any], list[np.ndarray]]:
    path = Path(request["path"])
    if request["kind"] == "parquet":
        columns = read_columns(path, request["columns"], optional=request["optional"])
        return {"columns": columns}, []
    with open_hdf5(path) as file:
        wanted = request["arrays"] | {
            name: shape for name, shape in request["optional"].items() if file.has(name)
        }
        arrays = {name: file.array(name, tuple(shape)) for name, shape in wanted.items()}
        texts = {name: file.texts(name) for name in request["texts"]}
    shapes = [(name, array.shape) for name, array in arrays.items()]
    return {"arrays": shapes, "texts": texts}, list(arrays.values())


if __name__ == "__main__":
    main()
