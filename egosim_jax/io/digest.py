"""Content hashes (SHA-256) of files, folders and values."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import CodeType, MethodType, ModuleType
from typing import Any

import numpy as np

from egosim_jax.io.bounded import open_regular


def sha256(path: Path) -> str:
    """Return the SHA-256 of a regular file, in hexadecimal."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_within(path: Path) -> str:
    """Return the SHA-256 of a file, or of the names and hashes of the files in a folder.

    Hidden files and subfolders are ignored.
    """
    if not path.is_dir():
        return sha256(path)
    files = [file for file in sorted(path.glob("[!.]*")) if file.is_file()]
    lines = "".join(f"{sha256(file)}  {file.name}\n" for file in files)
    return hashlib.sha256(lines.encode("utf-8", "surrogateescape")).hexdigest()


def fingerprint(value: Any) -> str:
    """Return the SHA-256 of a value's content, in hexadecimal.

    Covers numbers, text, paths, arrays, containers, dataclasses and callables. An object with a
    method `fingerprint` provides its own. Functions are hashed by name, source, defaults and
    closure; other objects by class, source of `__call__` and attributes. Globals, files and the
    code of called functions are not covered.
    """
    digest = hashlib.sha256()
    for part in _parts(value, ()):
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def _parts(value: Any, within: tuple[int, ...]) -> Iterator[bytes]:
    if value is None or isinstance(value, (bool, int, float, str, bytes, Path)):
        yield f"{type(value).__name__} {value!r}".encode("utf-8", "surrogatepass")
        return
    if id(value) in within:
        yield b"cycle"
        return
    within = (*within, id(value))
    if isinstance(value, Mapping):
        yield b"mapping"
        for key, item in sorted(value.items(), key=lambda pair: repr(pair[0])):
            yield from _parts(key, within)
            yield from _parts(item, within)
    elif isinstance(value, (list, tuple)):
        yield f"sequence of {len(value)}".encode()
        for item in value:
            yield from _parts(item, within)
    elif callable(getattr(value, "fingerprint", None)) and not isinstance(value, type):
        yield str(value.fingerprint()).encode()
    elif isinstance(value, ModuleType):
        yield f"module {value.__name__}".encode()
    elif isinstance(value, type):
        yield f"type {value.__qualname__}".encode()
    elif hasattr(value, "__array__"):
        array = np.ascontiguousarray(value)
        yield f"array {array.dtype} {array.shape}".encode()
        yield array.tobytes()
    elif isinstance(value, functools.partial):
        yield from _parts(("partial", value.func, value.args, value.keywords), within)
    elif isinstance(value, MethodType):
        yield from _parts((value.__func__, value.__self__), within)
    elif inspect.isfunction(value):
        yield from _function(value, within)
    elif inspect.isbuiltin(value):
        yield f"builtin {value.__module__} {value.__qualname__}".encode()
    else:
        yield from _object(value, within)


def _function(function: Callable[..., Any], within: tuple[int, ...]) -> Iterator[bytes]:
    plain: Any = inspect.unwrap(function)
    yield f"function {plain.__qualname__}".encode()
    try:
        source = inspect.getsource(plain).encode("utf-8", "surrogatepass")
    except (OSError, TypeError):
        source = b""
    # The source line of a lambda may hold other lambdas, too: hash its bytecode instead.
    yield from [source] if source and plain.__name__ != "<lambda>" else _code(plain.__code__)
    yield from _parts((plain.__defaults__, plain.__kwdefaults__), within)
    for cell in plain.__closure__ or ():
        try:
            content = cell.cell_contents
        except ValueError:  # not filled yet
            continue
        yield from _parts(content, within)


def _code(code: CodeType) -> Iterator[bytes]:
    """Yield a function's instructions and constants, without its file and line numbers."""
    yield code.co_code
    yield repr(code.co_names).encode()
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code(constant)
        else:
            yield repr(constant).encode("utf-8", "surrogatepass")


def _object(value: Any, within: tuple[int, ...]) -> Iterator[bytes]:
    kind = type(value)
    yield f"object {kind.__qualname__}".encode()
    call = getattr(kind, "__call__", None)  # noqa: B004 - its source is needed
    if inspect.isfunction(call):
        yield from _function(call, within)
    if dataclasses.is_dataclass(value):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    else:
        fields = getattr(value, "__dict__", {})
    yield from _parts(fields, within)
