"""Text of files for a terminal: nothing in it can be read as a command."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


def printable(text: object) -> str:
    """Return text with its control characters escaped, except the ends of lines.

    A terminal would run the escape sequences in a name or caption.
    """
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in str(text))


def make_console(*, width: int | None = None) -> Console:
    """Return a console that prints tables of untrusted text: escaped, and without markup.

    `width` is for files and pipes. A terminal has one, to which tables are folded.
    """
    from rich.console import Console

    class PlainConsole(Console):
        def render_str(self, text: str, **options: object) -> object:  # pyright: ignore
            return super().render_str(printable(text), **options)  # pyright: ignore

    width = None if sys.stdout.isatty() else width
    return PlainConsole(width=width, markup=False, emoji=False, highlight=False)


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: "1 clip", "2 clips"."""
    return f"{number} {noun}{'s' * (number != 1)}"
