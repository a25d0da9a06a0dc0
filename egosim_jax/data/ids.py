"""Ids of clips and recordings, which name files and folders."""

from __future__ import annotations

import re

_SAFE_ID = re.compile(r"(?:[A-Za-z0-9_-]+/)*[A-Za-z0-9_-][A-Za-z0-9._-]*")
SAFE_IDS = "letters, digits, '.', '_' and '-', and '/' between folders without dots"
"""Rule of a safe id, for messages."""


def is_safe_id(video_id: str) -> bool:
    """Return True if an id may name output files, in subfolders if it has slashes.

    Folders have no dots, so that an id cannot collide with the file of another one.
    """
    return len(video_id) <= 200 and _SAFE_ID.fullmatch(video_id) is not None
