"""Files of a MuJoCo model: all are regular, and nothing outside their folder is named.

MuJoCo opens any path that its XML names, and waits for a pipe. So the folder is checked before
MuJoCo reads it. Memory and time are bounded by the child process that compiles the model
(`isolated.py`).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NoReturn
from xml.parsers import expat

from egosim_jax.io.bounded import (
    open_regular,
    quote,
    quote_path,
    read_bytes,
    real_path,
    refusing,
)
from egosim_jax.io.untrusted.xml_tree import MAX_XML_BYTES
from egosim_jax.types import InputError

MAX_FILES = 10_000
"""Maximum number of files and folders of a model."""
OUTSIDE = re.compile(r"[/\\]|[A-Za-z]:|(.*[/\\])?\.\.([/\\]|$)", re.DOTALL)
"""Beginning of a path that can lead out of a folder; MuJoCo takes both slashes."""


def check_files(folder: Path) -> None:
    """Raise `InputError` unless a model can only read regular files of its folder."""
    root = real_path(folder)
    for number, path in enumerate(sorted(root.rglob("*"))):
        if number == MAX_FILES:
            raise InputError(
                f"{quote_path(folder)} has more than {MAX_FILES:,} files, the maximum of a robot's "
                "model. Give the folder of one model."
            )
        if not real_path(path).is_relative_to(root):
            raise InputError(
                f"{quote_path(path)} is a link out of its folder, which is not followed: put a "
                "copy of the file in its place."
            )
        if not path.is_dir():
            open_regular(path).close()
        if path.suffix == ".xml":
            _check_xml(path)


def _check_xml(path: Path) -> None:
    """Raise `InputError` if an XML file is not one of MuJoCo's, or names a path elsewhere."""
    name = quote_path(path)

    def refuse(*_: Any) -> NoReturn:
        # MuJoCo's parser ends a document type at another place, and would read other elements.
        raise InputError(f"{name} has a document type, which no model needs: remove it.")

    def check(tag: str, attributes: dict[str, str]) -> None:
        for key, value in attributes.items():
            is_path = key.startswith("file") or key.endswith("dir")
            if is_path and OUTSIDE.match(value):
                raise InputError(
                    f"{name} names {quote(value)} ({tag} {key}): a model reads only its own "
                    "folder. Put the file into it."
                )
            if key == "file" and tag in ("include", "model") and not value.endswith(".xml"):
                raise InputError(f"{name} includes {quote(value)}: its name must end with .xml.")

    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler, parser.StartDoctypeDeclHandler = check, refuse
    with refusing(f"{name} is not valid XML"):
        parser.Parse(read_bytes(path, limit=MAX_XML_BYTES), True)
