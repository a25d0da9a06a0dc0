"""The folder of a run: its config, its environment, and files that are whole or absent."""

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

from egosim_jax.io.atomic import atomic_write, hold_folder
from egosim_jax.io.untrusted import listing, quote, quote_text, read_json
from egosim_jax.types import InputError

CONFIG, ENVIRONMENT = "config.json", "environment.json"
PLACE = "out"
"""Name of fields that say where to write."""
PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "numpy", "av")


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write dataclasses, mappings, sequences, numbers and paths as JSON, whole or not at all."""
    write_text(path, json.dumps(plain(value), indent=2) + "\n")


def plain(value: Any) -> Any:
    """The JSON form of a value; dataclasses carry their class name so that unions stay readable."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, **fields}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, Fraction):
        return float(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(value)


def environment() -> dict[str, Any]:
    """Versions, devices and the commit: an allow-list, so that no secret is ever recorded."""
    import jax

    return {
        "python": platform.python_version(),
        "system": platform.platform(),
        "packages": {name: metadata.version(name) for name in ("egosim-jax", *PACKAGES)},
        "devices": [device.device_kind for device in jax.devices()],
        "processes": jax.process_count(),
        "cpus": os.cpu_count(),
        "commit": _commit(),
    }


def _commit() -> str | None:
    """The commit of the checkout this package runs from, if it is one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def open_folder(folder: Path, config: Any, *, may_differ: Collection[str] = ()) -> None:
    """Make a run folder and record config and environment, or continue in one of equal config.

    The folder is locked until the process ends. Fields named `out` are places, not settings: a
    folder that was moved stays the same run. Fields whose dotted paths are in `may_differ`, with
    all below them, may differ, too. Of several processes the first one locks and writes. Raises
    `InputError` when the folder cannot be written, is in use, lost its record, or holds a run of
    another config, naming the fields that differ.
    """
    import jax

    path, wanted = folder / CONFIG, plain(config)
    try:
        if jax.process_index() == 0:
            hold_folder(folder)
        recorded = read_json(path) if path.exists() else None
    except OSError as error:
        raise InputError(f"Cannot write to {folder}: {error.strerror}. (--out)") from error
    if recorded is None and (folder / ENVIRONMENT).exists():
        raise InputError(
            f"{path} is missing, although {folder} holds a run: without it nobody knows of which "
            "config. Restore it, or choose another --out."
        )
    if recorded is not None:
        if not isinstance(recorded, dict):
            raise InputError(f"{path} is not the record of a config. Restore it. (--out)")
        differing = [
            f"{field}: {what}"
            for field, what in sorted(_differences(recorded, wanted).items())
            if not any(f"{field}.".startswith(f"{free}.") for free in may_differ)
        ]
        if differing:
            raise InputError(
                f"{folder} holds a run of another config. Choose another --out, or the same "
                f"config: {listing(differing)}."
            )
    if jax.process_index() == 0:
        write_json(path, config)
        write_json(folder / ENVIRONMENT, environment())


def _differences(have: Any, want: Any, path: str = "") -> dict[str, str]:
    """Return what differs by the dotted path of its field; places to write to are not compared."""
    if isinstance(have, dict) and isinstance(want, dict):
        found = {}
        for key in have.keys() | want.keys():
            if key != PLACE:
                below = f"{path}.{quote_text(key)}" if path else quote_text(key)
                found |= _differences(have.get(key), want.get(key), below)
        return found
    if have == want:
        return {}
    return {path: f"the folder has {quote(have)}, this run has {quote(want)}"}
