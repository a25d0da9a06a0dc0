"""Fields of requests: names, numbers, prompts and maps, as a client sends them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from numbers import Integral
from typing import Any

from egosim_jax.io.bounded import quote
from egosim_jax.types import InputError

NAMES = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
"""Names of sessions and of what is saved."""


def check_name(name: object, what: str) -> str:
    """Return a name that is safe as a folder's. Raises `InputError` for any other."""
    if not isinstance(name, str) or not NAMES.fullmatch(name):
        raise InputError(
            f"{what} is {quote(name)}: it must have 1 to 64 letters, digits, _ or -, and begin "
            "with a letter or digit."
        )
    return name


def whole(value: object, what: str) -> int:
    """Return a whole number, also one of NumPy's. Raises `InputError` for any other value."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise InputError(f"{what} is {quote(value)}: it must be a whole number.")
    return int(value)


def prompt_of(request: Mapping[str, Any]) -> str | None:
    """Return the prompt of a request, if it has one. Raises `InputError` for any other value."""
    prompt = request.get("prompt")
    if prompt is not None and not (isinstance(prompt, str) and len(prompt) <= 2000):
        raise InputError(f"prompt is {quote(prompt)}: it must be a text of at most 2000.")
    return prompt


def mapping(value: object, what: str) -> Mapping[str, Any]:
    """Return a map from names to values. Raises `InputError` for any other value."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise InputError(f"{what} is {quote(value)}: it must be a map from names to values.")
    return value
