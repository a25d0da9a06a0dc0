"""SHA-256 of files and folders."""

from __future__ import annotations

import hashlib
from pathlib import Path

from egosim_jax.io.bounded import open_regular


def sha256(path: Path) -> str:
    """Return the SHA-256 of a regular file, in hexadecimal."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_within(path: Path) -> str:
    """Return the SHA-256 of a file, or that of the names and hashes of the files in a folder.

    Files whose names start with a dot do not count, nor do subfolders.
    """
    if not path.is_dir():
        return sha256(path)
    files = [file for file in sorted(path.glob("[!.]*")) if file.is_file()]
    lines = "".join(f"{sha256(file)}  {file.name}\n" for file in files)
    return hashlib.sha256(lines.encode("utf-8", "surrogateescape")).hexdigest()
