"""Values of a TOML table, taken one by one, with messages that name them."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from math import isfinite
from typing import Any

import numpy as np
from jaxtyping import Float

from egosim_jax.io.bounded import quote, quote_text
from egosim_jax.types import InputError

_REQUIRED: Any = object()
"""Default of a key that must be given."""


def nearest(name: str, names: Iterable[str]) -> str:
    """Return a suggestion for a message: the nearest of some names, and a part of all."""
    listed = [known for known in names if known]
    near = difflib.get_close_matches(name, listed, n=1, cutoff=0.4)
    hint = f" Did you mean {quote(near[0])}?" if near else ""
    shown = ", ".join(quote_text(known) for known in listed[:30])
    return f"{hint} There are: {shown or 'none'}{', ...' if len(listed) > 30 else ''}."


class Table:
    """A table of TOML whose values are taken one by one, with messages that name them."""

    def __init__(self, values: Mapping[str, Any], name: str, prefix: str = "") -> None:
        self.values, self.name, self.prefix = values, name, prefix
        self.taken: set[str] = set()

    def place(self, key: str) -> str:
        """Return the name of a value for a message."""
        return f"{self.name}: {self.prefix}{key}"

    def end(self) -> None:
        """Raise `InputError` for a key that was not taken."""
        if unknown := [key for key in self.values if key not in self.taken]:
            raise InputError(
                f"{self.place(quote_text(unknown[0]))} is no part of a robot's description."
                f"{nearest(unknown[0], sorted(self.taken))}"
            )

    def _take(self, key: str, default: Any = _REQUIRED) -> Any:
        self.taken.add(key)
        if key not in self.values:
            if default is _REQUIRED:
                raise InputError(
                    f"{self.name} has no {self.prefix}{key}: a robot's description needs it "
                    "(docs/robot.md)."
                )
            return default
        return self.values[key]

    def _refuse(self, key: str, value: Any, rule: str) -> InputError:
        return InputError(f"{self.place(key)} is {quote(value)}: it must be {rule}.")

    def text_of(self, key: str, value: Any) -> str:
        """Return a text."""
        if not isinstance(value, str) or not value or not value.isprintable():
            raise self._refuse(key, value, "a text")
        return value

    def text(self, key: str, default: Any = _REQUIRED) -> str:
        """Return the text of a key."""
        value = self._take(key, default)
        return value if value is default else self.text_of(key, value)

    def texts(self, key: str, default: Any = _REQUIRED) -> tuple[str, ...]:
        """Return different texts."""
        value = self._take(key, default)
        if value is default:
            return value
        if not isinstance(value, list) or not value:
            raise self._refuse(key, value, "a list of names")
        names = tuple(self.text_of(f"{key}[{n}]", entry) for n, entry in enumerate(value))
        if len(set(names)) < len(names):
            raise self._refuse(key, value, "a list of different names")
        return names

    def choice(self, key: str, choices: tuple[str, ...], default: Any = _REQUIRED) -> Any:
        """Return one of some texts."""
        value = self._take(key, default)
        if value not in choices:
            raise self._refuse(key, value, f"one of {', '.join(choices)}")
        return value

    def number_of(self, key: str, value: Any, low: float | None = None) -> float:
        """Return a finite number, above `low`."""
        good = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not good or not isfinite(value) or (low is not None and value <= low):
            above = "" if low is None else f" above {low:g}"
            raise self._refuse(key, value, f"a finite number{above}")
        return float(value)

    def number(self, key: str, default: Any = _REQUIRED, low: float | None = None) -> float:
        """Return the number of a key."""
        return self.number_of(key, self._take(key, default), low)

    def count(self, key: str) -> int:
        """Return a positive whole number."""
        value = self._take(key)
        if type(value) is not int or not 0 < value < 1 << 16:
            raise self._refuse(key, value, "a positive whole number")
        return value

    def numbers_of(self, key: str, value: Any, count: int, low: float | None = None) -> list[float]:
        """Return so many numbers."""
        if not isinstance(value, list) or len(value) != count:
            raise self._refuse(key, value, f"a list of {count} numbers")
        return [self.number_of(f"{key}[{n}]", entry, low) for n, entry in enumerate(value)]

    def numbers(
        self, key: str, count: int, default: Any = _REQUIRED, low: float | None = None
    ) -> list[float]:
        """Return the numbers of a key."""
        value = self._take(key, default)
        return list(value) if value is default else self.numbers_of(key, value, count, low)

    def matrix(self, key: str, size: int) -> Float[np.ndarray, "n n"]:
        """Return a square matrix."""
        value = self._take(key)
        if not isinstance(value, list) or len(value) != size:
            raise self._refuse(key, value, f"a list of {size} rows of {size} numbers")
        rows = [self.numbers_of(f"{key}[{n}]", row, size) for n, row in enumerate(value)]
        return np.array(rows, float)

    def pair(self, key: str) -> list[Any]:
        """Return a list of two values."""
        value = self._take(key)
        if not isinstance(value, list) or len(value) != 2:
            raise self._refuse(key, value, "a list of two tables")
        return value

    def item(self, key: str, number: int, value: Any) -> Table:
        """Return a table in a list."""
        if not isinstance(value, dict):
            raise self._refuse(f"{key}[{number}]", value, "a table")
        return Table(value, self.name, f"{self.prefix}{key}[{number}].")

    def table(self, key: str) -> Table:
        """Return the table of a key."""
        return Table(self._dict(key, _REQUIRED), self.name, f"{self.prefix}{key}.")

    def open(self, key: str) -> Mapping[str, Any]:
        """Return a table of any keys; empty if it is absent."""
        return self._dict(key, {})

    def _dict(self, key: str, default: Any) -> Mapping[str, Any]:
        value = self._take(key, default)
        if not isinstance(value, dict):
            raise self._refuse(key, value, "a table")
        return value
