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

from egosim_jax.io.atomic import atomic_write
from egosim_jax.types import InputError

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

    A folder that was moved stays the same run: `out` may differ, and so may the fields whose dotted
    paths are given, with all below them. Of several processes the first one writes. Raises
    `InputError` when the folder cannot be written or holds a run of another config, naming the
    fields that differ.
    """
    import jax

    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable-{jax.process_index()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"Cannot write to {folder}: {error.strerror}. (--out)") from error
    path, wanted = folder / "config.json", plain(config)
    if path.is_file():
        found = _differences(json.loads(path.read_text("utf-8")), wanted)
        differing = [
            f"  {field}: {what}"
            for field, what in sorted(found.items())
            if not any(f"{field}.".startswith(f"{free}.") for free in ("out", *may_differ))
        ]
        if differing:
            raise InputError(
                "\n".join(
                    [
                        f"{folder} holds a run of another config; choose another --out or the "
                        "same config:",
                        *differing,
                    ]
                )
            )
    if jax.process_index() == 0:
        write_json(path, config)
        write_json(folder / "environment.json", environment())


def _differences(have: Any, want: Any, path: str = "") -> dict[str, str]:
    """What differs, by the dotted path of its field."""
    if isinstance(have, dict) and isinstance(want, dict):
        found = {}
        for key in have.keys() | want.keys():
            below = f"{path}.{key}" if path else key
            found |= _differences(have.get(key), want.get(key), below)
        return found
    return {} if have == want else {path: f"the folder has {have}, this run has {want}"}
