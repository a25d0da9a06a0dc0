"""Text of files is escaped on a terminal."""

import pytest
from rich.table import Table

from egosim_jax.runtime.command import run_with_exit_codes
from egosim_jax.runtime.terminal import make_console, printable
from egosim_jax.types import InputError

HOSTILE = {
    "color": "\x1b[31mred",
    "title": "\x1b]0;title\x07",
    "cursor": "a\rb\x08",
    "C1": "\x9b31m",
    "direction": "\u202eabc",
    "markup": "[/red] [bold]a",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_control_characters_are_escaped(kind):
    assert printable(HOSTILE[kind]).isprintable()
    assert printable(f"one\n{HOSTILE[kind]}").count("\n") == 1
    assert printable("a hand picks up the é 🍎") == "a hand picks up the é 🍎"


@pytest.mark.parametrize("kind", HOSTILE)
def test_tables_show_text_as_it_is(kind, capsys):
    table = Table("name", HOSTILE[kind], title=HOSTILE[kind])
    table.add_row(HOSTILE[kind], "1")
    make_console(width=100).print(table)
    shown = capsys.readouterr().out
    assert all(line.isprintable() for line in shown.splitlines())
    assert shown.count(printable(HOSTILE[kind])) == 3


@pytest.mark.parametrize(
    ("error", "kind"), [(InputError, "color"), (OSError, "title"), (RuntimeError, "C1")]
)
def test_errors_are_escaped(kind, error, capsys):
    def run():
        raise error(HOSTILE[kind])

    run_with_exit_codes(run)
    assert all(line.isprintable() for line in capsys.readouterr().err.splitlines())
