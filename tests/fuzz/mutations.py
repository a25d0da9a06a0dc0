"""Changes to a file that know nothing of its format."""

from __future__ import annotations

import re
from random import Random

INTERESTING = (0, 1, -1, 127, 128, 255, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, -(2**63), 10**20)
NUMBERS = (0, 1, 2, 3, 255, 65_535, 65_536, 2**31 - 1, 2**31, 2**32 - 1)
"""Values for an unsigned field of 32 bits."""


def flip(data: bytes, random: Random) -> bytes:
    """Flip one bit, seldom several."""
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 8))):
        if changed:
            changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
    return bytes(changed)


def truncate(data: bytes, random: Random) -> bytes:
    """Cut the end off."""
    return data[: random.randrange(len(data) + 1)]


def extend(data: bytes, random: Random) -> bytes:
    """Append random bytes."""
    return data + random.randbytes(random.choice((1, 16, 5000)))


def replace(data: bytes, random: Random) -> bytes:
    """Replace a range by zeros, ones or noise of the same length."""
    start, end = _range(data, random)
    filler = random.choice((b"\0", b"\xff", b" ", b""))
    return data[:start] + (filler * (end - start) or random.randbytes(end - start)) + data[end:]


def remove(data: bytes, random: Random) -> bytes:
    """Leave a range out."""
    start, end = _range(data, random)
    return data[:start] + data[end:]


def repeat(data: bytes, random: Random) -> bytes:
    """Repeat a range."""
    start, end = _range(data, random)
    return data[:end] + data[start:end] * random.choice((1, 1, 3, 100)) + data[end:]


def exchange(data: bytes, random: Random) -> bytes:
    """Exchange two ranges that follow each other."""
    start, end = _range(data, random)
    middle = random.randint(start, end)
    return data[:start] + data[middle:end] + data[start:middle] + data[end:]


def number(data: bytes, random: Random) -> bytes:
    """Write an interesting number over some bytes, or instead of digits."""
    value = random.choice(INTERESTING)
    digits = [found.span() for found in re.finditer(rb"\d+", data[:100_000])]
    if digits and random.random() < 0.5:
        start, end = random.choice(digits)
        return data[:start] + str(value).encode() + data[end:]
    size = random.choice((1, 2, 4, 8))
    start = random.randrange(max(1, len(data)))
    written = (value % 2 ** (8 * size)).to_bytes(size, random.choice(("little", "big")))
    return data[:start] + written + data[start + size :]


VALUES = ("null", "[]", "{}", "-1", "1e999", "NaN", '"\\ud800"', "[" * 3000, "9" * 5000, "true")


def json_value(data: bytes, random: Random) -> bytes:
    """Replace a JSON value by one of another kind."""
    text = data.decode("utf-8", "replace")
    colons = [place for place, letter in enumerate(text) if letter == ":"]
    if not colons:
        return data
    start = random.choice(colons) + 1
    ends = [place for mark in ",}\n" if (place := text.find(mark, start)) >= 0]
    return (text[:start] + random.choice(VALUES) + text[min(ends, default=start) :]).encode()


BYTES = (flip, truncate, extend, replace, remove, repeat, exchange, number)


def _range(data: bytes, random: Random) -> tuple[int, int]:
    start = random.randint(0, len(data))
    return start, min(len(data), start + random.choice((1, 4, 32, 500, len(data))))
