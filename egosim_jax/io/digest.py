"""SHA-256 of files."""

from __future__ import annotations

import hashlib
from pathlib import Path

from egosim_jax.io.untrusted import open_regular


def sha256(path: Path) -> str:
    """Return the SHA-256 of a regular file, in hexadecimal."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
