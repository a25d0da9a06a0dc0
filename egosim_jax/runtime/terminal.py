"""Text of files for a terminal: nothing in it can be read as a command, and all is UTF-8."""

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


def not_utf8(name: str) -> str:
    """Return the message for a name, or a text with a name, that is not UTF-8."""
    return (
        f"{printable(name)} is not valid UTF-8: the files that commands write could not name it. "
        "Rename it, for instance by `convmv -f latin1 -t utf8 --notest PATH`."
    )


def check_utf8(name: object) -> None:
    """Raise `InputError` for the name of a file that is not UTF-8.

    Python's text for such a name has surrogates, which no file and few libraries take.
    """
    from egosim_jax.types import InputError  # imports NumPy: too slow for a command's first line

    try:
        str(name).encode()
    except UnicodeEncodeError as error:
        raise InputError(not_utf8(str(name))) from error


def print_line(text: object) -> None:
    """Print a result on stdout, such as a path, escaped (`printable`)."""
    print(printable(text), flush=True)


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
