"""Run folders with config and environment, and atomic writing of text and JSON."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import subprocess
from collections.abc import Collection, Mapping
from fractions import Fraction
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.atomic import atomic_write, hold_folder
from egosim_jax.io.bounded import MAX_QUOTED, quote, quote_text, read_json
from egosim_jax.io.journal import describe
from egosim_jax.runtime.terminal import check_utf8
from egosim_jax.types import InputError

CONFIG, ENVIRONMENT = "config.json", "environment.json"
OUTPUT = "out"
"""Name of config fields with an output folder, which are not compared."""
MAX_REFUSAL_BYTES = 4096
"""Length of the message that the first process of a run sends to the others."""
PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "numpy", "av")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write dataclasses, mappings, sequences, numbers and paths as JSON, atomically."""
    write_text(path, json.dumps(plain(value), indent=2) + "\n")


def plain(value: Any) -> Any:
    """Return the JSON form of a value; dataclasses get their class name as `type`.

    Raises `InputError` for the name of a file that is not UTF-8: it could not be read again.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, **fields}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, Fraction):
        return float(value)
    if value is None or isinstance(value, (bool, int, float)):
        return value
    check_utf8(value)
    return str(value)


def environment() -> dict[str, Any]:
    """Return versions, devices and the commit: an allow-list, so that no secret is recorded."""
    import jax

    return {
        "python": platform.python_version(),
        "system": platform.platform(),
        "packages": {name: _version(name) for name in ("egosim-jax", *PACKAGES)},
        "devices": [device.device_kind for device in jax.devices()],
        "processes": jax.process_count(),
        "cpus": os.cpu_count(),
        "commit": _commit(),
    }


def _version(package: str) -> str | None:
    """Return the version of a package; None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Return the commit of the checkout that this package runs from; None outside a checkout.

    An installed package has no commit, even if its environment is inside another checkout.
    """
    root = Path(__file__).resolve().parents[2]
    command = ["git", "-C", str(root), "rev-parse", "--show-toplevel", "HEAD"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None
    toplevel, commit = result.stdout.splitlines()
    return commit if Path(toplevel).resolve() == root else None


def open_folder(
    folder: Path, config: Any, *, mutable: Collection[str] = (), begun: bool = True
) -> None:
    """Create a run folder with config and environment, or resume in one with an equal config.

    The folder is locked until the process ends. Fields named `out` are not compared, so that a
    folder can be moved. Fields whose dotted paths are in `mutable`, or below, are not compared
    either, and a folder whose run has not `begun` takes any config. All processes of a run call
    this: the first locks, compares and writes, then the others compare with it; what the first one
    refuses, all refuse. Raises `InputError` when the folder cannot be written, is in use, lost its
    config, or holds a run of another config, naming the fields that differ.
    """
    import jax

    refusal = ""
    if jax.process_index() == 0:
        try:
            _begin(folder, config, mutable if begun else None)
        except InputError as error:
            refusal = str(error)
    if jax.process_count() > 1:
        refusal = _of_the_first_process(refusal)
    if refusal:
        raise InputError(refusal)
    if jax.process_index() != 0:
        _compare(folder, config, mutable)


def _of_the_first_process(text: str) -> str:
    """Return the text of the first process in all processes, for which each waits."""
    from jax.experimental import multihost_utils

    data = text.encode()[:MAX_REFUSAL_BYTES].ljust(MAX_REFUSAL_BYTES, b"\0")
    shared = multihost_utils.broadcast_one_to_all(np.frombuffer(data, np.uint8))
    return np.asarray(shared, np.uint8).tobytes().rstrip(b"\0").decode("utf-8", "ignore")


def _begin(folder: Path, config: Any, mutable: Collection[str] | None) -> None:
    """Lock a folder, compare its config, unless all is mutable (None), and write this run's."""
    try:
        hold_folder(folder)
        is_known = (folder / CONFIG).exists()
    except OSError as error:
        raise InputError(f"Cannot write to {folder}: {error.strerror}. (--out)") from error
    if not is_known and (folder / ENVIRONMENT).exists():
        raise InputError(
            f"{folder / CONFIG} is missing, although {folder} holds a run: its config is unknown. "
            "Restore the file, or choose another --out."
        )
    if mutable is not None:
        _compare(folder, config, mutable)
    write_json(folder / CONFIG, config)
    write_json(folder / ENVIRONMENT, environment())


def _compare(folder: Path, config: Any, mutable: Collection[str]) -> None:
    """Raise `InputError` if a folder has another config."""
    path, wanted = folder / CONFIG, plain(config)
    if path.exists():
        recorded = read_json(path)
        if not isinstance(recorded, dict):
            raise InputError(f"{path} is not a config. Restore it. (--out)")
        differing = {
            field: values
            for field, values in _differences(recorded, wanted).items()
            if not any(f"{field}.".startswith(f"{free}.") for free in mutable)
        }
        if differing:
            raise InputError(
                f"{folder} holds a run of another config. Choose another --out, or the same "
                f"config: {describe(differing)}."
            )


def _differences(recorded: Any, wanted: Any, path: str = "") -> dict[str, tuple[str, str]]:
    """Return the two values where configs differ, by dotted path, `out` fields excluded."""
    if isinstance(recorded, dict) and isinstance(wanted, dict):
        found = {}
        for key in recorded.keys() | wanted.keys():
            if key != OUTPUT:
                below = f"{path}.{quote_text(key)}" if path else quote_text(key)
                found |= _differences(recorded.get(key), wanted.get(key), below)
        return found
    if recorded == wanted:
        return {}
    lists = isinstance(recorded, list) and isinstance(wanted, list)
    if lists and len(recorded) == len(wanted):
        found = {}
        for number, (one, other) in enumerate(zip(recorded, wanted, strict=True)):
            found |= _differences(one, other, f"{path}.{number}")
        return found
    one, other = _shown(recorded), _shown(wanted)
    equal = next((n for n, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), 0)
    begin = equal - MAX_QUOTED // 4 if equal > MAX_QUOTED // 2 else 0  # to show the difference
    one, other = (f"{'…' * (begin > 0)}{quote_text(text[begin:])}" for text in (one, other))
    return {path: (one, other)}


def _shown(value: Any) -> str:
    if isinstance(value, str):
        return f"'{value}'"
    return json.dumps(value) if isinstance(value, list | dict) else quote(value)
