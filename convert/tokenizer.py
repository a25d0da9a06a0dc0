"""Files of a checkpoint's tokenizer, which are copied as they are."""

from __future__ import annotations

import os
from pathlib import Path

from egosim_jax.io.bounded import quote_path, read_bytes
from egosim_jax.types import InputError

TOKENIZER_FILES = (
    "tokenizer.json", "spiece.model", "tokenizer_config.json", "special_tokens_map.json",
)  # fmt: skip
MAX_TOKENIZER = 64 << 20
"""Bytes of a tokenizer file."""


def tokenizer_files(folder: Path, *, within: Path) -> dict[str, bytes]:
    """Read the files of a tokenizer. Raises `InputError` for symlinks, which may point anywhere."""
    files = [folder / name for name in TOKENIZER_FILES if os.path.lexists(folder / name)]
    inner = [path for path in (folder, *folder.parents) if within in path.parents]
    for path in (*inner, *files):
        if path.is_symlink():
            raise InputError(
                f"{quote_path(path)} is a symlink; those of a tokenizer are not followed. Copy the "
                "checkpoint folder with `cp -rL` if you trust the targets of its links."
            )
    return {file.name: read_bytes(file, limit=MAX_TOKENIZER) for file in files}
