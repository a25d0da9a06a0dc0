"""Cut files into parts of limited size, and join them again.

A folder of parts has `parts.json`, with the SHA-256 of every file and of its parts in order, and
the parts, `NAME.000`, `NAME.001`, ...
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from egosim_jax.io.atomic import atomic_folder, atomic_write
from egosim_jax.io.bounded import quote, quote_path, read_bytes, read_json
from egosim_jax.io.digest import sha256
from egosim_jax.io.mapped import digest
from egosim_jax.io.run import write_json
from egosim_jax.types import InputError

DESCRIPTION = "parts.json"
PART_BYTES = 16 << 20
"""Maximum size of a part in bytes."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")


def cut(files: Sequence[Path], folder: Path, *, part_bytes: int = PART_BYTES) -> None:
    """Cut files into parts in a folder, which is replaced in one step."""
    described = {}
    with atomic_folder(folder) as temporary:
        for path in files:
            parts = []
            with path.open("rb") as file:
                while data := file.read(part_bytes):
                    name = f"{path.name}.{len(parts):03d}"
                    (temporary / name).write_bytes(data)
                    parts.append({"file": name, "sha256": digest(data)})
            described[path.name] = {"sha256": sha256(path), "parts": parts}
        write_json(temporary / DESCRIPTION, {"files": described})


def join(folder: Path, out: Path) -> list[Path]:
    """Join the parts in a folder to files in the folder `out`; return their paths.

    Raises `InputError` naming the first missing or damaged part; its file is not written.
    """
    joined = []
    for name, entry in _described(folder).items():
        path = out / name
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            for part in entry["parts"]:
                data = read_bytes(folder / part["file"], limit=PART_BYTES)
                if digest(data) != part["sha256"]:
                    raise InputError(
                        f"{quote_path(folder / part['file'])} is damaged: its SHA-256 differs "
                        f"from the one in {DESCRIPTION}. Copy it again."
                    )
                file.write(data)
            file.flush()
            if sha256(temporary) != entry["sha256"]:
                raise InputError(
                    f"{name}, joined from {quote_path(folder)}, does not have the SHA-256 in "
                    f"{DESCRIPTION}. Copy the folder again."
                )
        joined.append(path)
    return joined


def _described(folder: Path) -> dict[str, Any]:
    """Return the description of each file in a folder of parts, after checking all names."""
    path = folder / DESCRIPTION
    found = read_json(path)
    files = found.get("files") if isinstance(found, dict) else None
    if not isinstance(files, dict) or not files:
        raise InputError(f"{quote_path(path)} does not name any files with parts.")
    for name, entry in files.items():
        match entry:
            case {"sha256": str(), "parts": [*parts]} if all(
                isinstance(part, dict)
                and isinstance(part.get("sha256"), str)
                and isinstance(part.get("file"), str)
                and _NAME.fullmatch(part["file"])
                for part in parts
            ) and _NAME.fullmatch(name):
                pass
            case _:
                raise InputError(f"{quote_path(path)} does not describe {quote(name)} as parts.")
    return files
