"""Options of the command that runs: their names as a user types them, and near names."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

UNITS = ("_px", "_m", "_db")
"""Units that names of fields have, and names of options have not."""


class _Shown:
    """Options of the command that runs; empty in a program that uses the package as a library."""

    options: Collection[str] = ()


@contextmanager
def show_options(command: Any) -> Iterator[None]:
    """Name fields by the options of a parsed command in messages, inside the context."""
    before = _Shown.options
    _Shown.options = {*_options(command)}
    try:
        yield
    finally:
        _Shown.options = before


def option_of(path: str) -> str | None:
    """Return the option of a field by its dotted path, or None if the command has no such option.

    `simulate.seed` is --seed, `cutting.quality.min_hands` is --min-hands. An option may begin
    anywhere in the path, because commands put options into nested configs.
    """
    names = path.split(".")
    for start in range(len(names)):
        for unit in ("", *UNITS):
            below = ".".join(names[start:])
            option = "--" + below.removesuffix(unit).replace("_", "-")
            if below.endswith(unit) and option in _Shown.options:
                return option
    return None


def meant(name: str, known: Collection[str]) -> str:
    """Return " Did you mean NAME?" for the nearest known name, or nothing if none is near."""
    near = difflib.get_close_matches(name, known, n=1)
    return f" Did you mean {near[0]}?" if near else ""


def _options(command: Any, prefix: str = "--") -> Iterator[str]:
    """Yield the options of a command; a subcommand's have no prefix (`command.py`)."""
    for field in fields(command):
        if "Positional" in str(field.type):
            continue
        value = getattr(command, field.name)
        name = prefix + field.name.replace("_", "-")
        if not is_dataclass(value):
            yield name
        else:
            yield from _options(value, prefix if field.name == "command" else f"{name}.")
