"""Messages as MessagePack with NumPy arrays, compatible with OpenPI, and as JSON.

Our own code, because msgpack-numpy unpickles arrays of objects and has no limits for hostile input.

An array is a map of `__ndarray__`, `data`, `dtype` and `shape`. A NumPy scalar is a map of
`__npgeneric__`, `data` and `dtype`. Their keys are bytes. msgpack-numpy of PyPI writes `nd` and
`type` instead of `__ndarray__` and `dtype`, and a scalar as bytes; both are read, and arrays are
sent with the keys of both. Nothing is unpickled: only numeric dtypes are read, and the shape must
match the number of bytes.
"""

from __future__ import annotations

import base64
import json
import re
from typing import Any

import numpy as np

from egosim_jax.io.bounded import parse_json, quote, quote_text, unique
from egosim_jax.types import InputError

MAX_BYTES = 16 << 20
"""Maximum size of a client's message in bytes."""
DTYPES = re.compile(r"[<>=]?(?:i[1248]|u[1248]|f[248])|[|]?(?:b1|i1|u1)")
"""Accepted dtypes. NumPy evaluates other names, such as lists with commas, as Python."""
MAX_LISTED = 512
"""Maximum number of values of an array that JSON stores as a list."""
MAX_DEPTH = 16
"""Maximum nesting depth of a message."""
MAX_ITEMS = 200_000
"""Maximum number of items in all lists and maps of a client's message."""


def pack(value: Any) -> bytes:
    """Return a message as MessagePack."""
    import msgpack

    return bytes(msgpack.Packer(default=_packed).pack(value))


def unpack(data: bytes, *, limit: int | None = None) -> Any:
    """Return the message of MessagePack bytes. Raises `InputError` if they are invalid.

    For untrusted messages, `limit` is the maximum size in bytes; it also bounds items and depth.
    """
    import msgpack

    if limit is not None and len(data) > limit:
        raise InputError(f"The message has {len(data):,} bytes: it may have at most {limit:,}.")
    items, max_length = 0, -1 if limit is None else MAX_ITEMS

    def counted(value: Any) -> Any:
        nonlocal items
        items += 1 + len(value)
        if limit is not None and items > MAX_ITEMS:
            raise InputError(
                f"The message has more than {MAX_ITEMS:,} items in its lists and maps, the "
                "maximum. Send NumPy arrays instead of lists."
            )
        return value

    # the hooks count while msgpack parses: a small message could otherwise fill the memory
    try:
        value = msgpack.unpackb(
            data,
            object_pairs_hook=lambda pairs: _unpacked(unique(counted(pairs))),
            list_hook=counted,
            strict_map_key=True,
            max_array_len=max_length,
            max_map_len=max_length,
        )
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, msgpack.UnpackException, RecursionError) as error:
        raise InputError(
            "The message is not MessagePack with numeric arrays, in the format of "
            "openpi_client.msgpack_numpy or msgpack_numpy: "
            f"{quote_text(str(error) or type(error).__name__)}."
        ) from error
    if limit is not None:
        _check_depth(value)
    return value


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind not in "biuf":
        raise TypeError(f"an array of {value.dtype} cannot be sent")
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value).tobytes()
        return {
            b"__ndarray__": True,
            b"nd": True,
            b"data": data,
            b"dtype": value.dtype.str,
            b"type": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _unpacked(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        return _array(value.get(b"data"), value.get(b"dtype"), value.get(b"shape"))
    if value.get(b"nd") is True:
        return _array(value.get(b"data"), value.get(b"type"), value.get(b"shape"))
    if b"nd" in value:
        return _array(value.get(b"data"), value.get(b"type"), [])[()]
    if b"complex" in value:
        raise InputError("The message has a complex number: send real numbers.")
    if b"__npgeneric__" in value:
        number = value.get(b"data")
        if not isinstance(number, bool | int | float):
            raise InputError(f"A NumPy scalar is {quote(number)}: it must be a number.")
        try:
            return _dtype(value.get(b"dtype")).type(number)
        except (OverflowError, ValueError) as error:
            raise InputError(f"A NumPy scalar is {quote(number)}: {quote_text(str(error))}.") from (
                error
            )
    return value


def _array(data: Any, dtype: Any, shape: Any) -> np.ndarray:
    kind = _dtype(dtype)
    sizes = isinstance(shape, list) and all(type(n) is int and 0 <= n < 1 << 31 for n in shape)
    if not isinstance(data, bytes) or not sizes or len(shape) > 8:
        raise InputError(
            f"An array has data {quote(data)} and shape {quote(shape)}: data must be bytes, the "
            "shape a list of at most 8 whole numbers."
        )
    count = 1  # a Python integer: np.prod would overflow
    for size in shape:
        count *= size
    if count * kind.itemsize != len(data):
        raise InputError(
            f"An array of {kind} has {len(data):,} bytes, its shape needs "
            f"{quote(count * kind.itemsize)}: they must agree."
        )
    return np.frombuffer(data, kind).reshape(shape)


def _dtype(name: Any) -> np.dtype:
    if not isinstance(name, str) or not DTYPES.fullmatch(name):
        raise InputError(
            f"The dtype of an array is {quote(name)}: it must be of numbers or bool. Convert it by "
            "np.asarray(rows, float)."
        )
    return np.dtype(name)


def _check_depth(value: Any) -> None:
    level = [value]
    for _ in range(MAX_DEPTH):
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return
    raise InputError(f"The message is nested more than {MAX_DEPTH} levels deep.")


def unpack_json(data: bytes) -> dict[str, Any]:
    """Return the object of a JSON body, with the bounds of `unpack`. Raises `InputError`."""
    # each item follows a comma or an opening bracket, so this bounds the items from above
    items = sum(data.count(mark) for mark in (b",", b"[", b"{"))
    if items > MAX_ITEMS:
        raise InputError(
            f"The body has {items:,} commas and brackets: it may have at most {MAX_ITEMS:,}. Send "
            "fewer rows, or use the websocket, which takes NumPy arrays."
        )
    value = parse_json(data, source="The body", limit=MAX_BYTES)
    if not isinstance(value, dict):
        raise InputError(f"The body is {quote(value)}: it must be a JSON object.")
    _check_depth(value)
    return value


def pack_json(value: Any) -> bytes:
    """Return a reply as JSON bytes."""
    return json.dumps(to_json(value), allow_nan=False).encode()


def to_json(value: Any) -> Any:
    """Convert a value for JSON: short arrays to lists, long ones to dtype, shape and Base64.

    NaN and infinity become null.
    """
    if isinstance(value, np.ndarray) and value.size <= MAX_LISTED:
        return to_json(value.tolist())
    if isinstance(value, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode("ascii")
        return {"dtype": value.dtype.str, "shape": list(value.shape), "base64": data}
    if isinstance(value, np.generic):
        return to_json(value.item())
    if isinstance(value, dict):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
