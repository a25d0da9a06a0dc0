"""Read PyTorch's `.pth` files without PyTorch and without executing their pickles.

A `.pth` is a zip archive of uncompressed entries: `NAME/data.pkl`, a pickle of dictionaries, lists
and references to tensors, and `NAME/data/KEY`, the bytes of each storage. A pickle is a program;
here a separate interpreter supports plain containers, numbers, text and tensors, refuses every
global that is not on its allow-list, and never calls any. Every tensor is checked against its
storage and stays in the memory-mapped file until it is accessed.
"""

from __future__ import annotations

import math
import pickletools
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.convert.archive import read_entries
from egosim_jax.io.mapped import (
    CODES,
    MOST_AXES,
    MOST_TENSORS,
    RefusedError,
    Tensor,
    check_name,
    check_sizes,
    map_file,
    strides_of,
)
from egosim_jax.io.untrusted import quote, quote_path, quote_text
from egosim_jax.types import InputError

STORAGES = {
    "DoubleStorage": "float64", "FloatStorage": "float32", "HalfStorage": "float16",
    "BFloat16Storage": "bfloat16", "LongStorage": "int64", "IntStorage": "int32",
    "ShortStorage": "int16", "CharStorage": "int8", "ByteStorage": "uint8", "BoolStorage": "bool",
}  # fmt: skip
"""Dtype of the elements of each of torch's storage classes."""
DTYPES = {dtype.name: dtype for dtype in CODES.values()} | {
    name: np.dtype(name) for name in ("float8_e4m3fnuz", "float8_e5m2fnuz")
}
"""NumPy dtypes by their names in torch."""
UNTYPED = "torch.storage.UntypedStorage"
MOST_PICKLE, MOST_STEPS, DEEPEST = 16 << 20, 1 << 20, 64
"""Limits: bytes and operations of the pickle, depth of nested containers."""
MOST_ITEMS, MOST_KEY = 1 << 20, 1 << 31
"""Limits: items of all containers, counted at every reference, and magnitude of integer keys."""


@dataclass(frozen=True)
class Name:
    """Dotted name of a global that the pickle references; the object is never loaded."""

    full: str


@dataclass(frozen=True)
class Storage:
    """Bytes that tensors are views of."""

    data: memoryview
    dtype: str | None
    """Element dtype; None for untyped storages, whose tensors have one."""


def read_pth(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a `.pth` file by name, nested keys joined by dots.

    The file stays mapped while any of them is alive. Raises `InputError` with the reason if it is
    not a `.pth` archive, is damaged, or has anything but tensors, plain values and containers.
    """
    data = map_file(path)
    try:
        return _flatten(_Interpreter(read_entries(data)).run())
    except (ValueError, struct.error) as error:
        reason = str(error) if isinstance(error, RefusedError) else quote_text(str(error))
        raise InputError(
            f"{quote_path(path)} cannot be read: {reason}. Only tensors in plain containers are "
            "supported, as torch.save writes state dicts. Save the weights again as such, or "
            "better as safetensors."
        ) from error


class _Interpreter:
    """Pickle interpreter for containers, numbers, text and tensors that calls no function."""

    def __init__(self, entries: Mapping[str, memoryview]):
        self.entries = entries
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def run(self) -> Any:
        """Return the object that the pickle describes."""
        program = self.entries["data.pkl"]
        if len(program) > MOST_PICKLE:
            raise RefusedError(
                f"its pickle has {len(program):,} bytes; the limit is {MOST_PICKLE:,}"
            )
        for step, (opcode, argument, _) in enumerate(pickletools.genops(bytes(program))):
            if step == MOST_STEPS:
                raise RefusedError(f"its pickle has more than {MOST_STEPS:,} operations")
            if opcode.name == "STOP":
                return self._pop()
            action = ACTIONS.get(opcode.name)
            if action is None:
                raise RefusedError(f"its pickle uses the unsupported operation {opcode.name}")
            action(self, argument)
        raise RefusedError("its pickle has no STOP")

    def push(self, value: Any) -> None:
        self.stack.append(value)

    def mark(self, _: None) -> None:
        self.marks.append(len(self.stack))

    def remember(self, number: int | None) -> None:
        self.memo[len(self.memo) if number is None else number] = self._top()

    def recall(self, number: int) -> None:
        if number not in self.memo:
            raise RefusedError(f"its pickle reads memo {number}, which is not set")
        self.push(self.memo[number])

    def name(self, text: str | None) -> None:
        if text is None:
            last, module = self._pop(), self._pop()
            if not (isinstance(last, str) and isinstance(module, str)):
                raise RefusedError("its pickle references a global whose name is not text")
            text = f"{module} {last}"
        full = text.replace(" ", ".", 1)
        if full not in ALLOWED:
            raise RefusedError(f"its pickle references the disallowed global {quote_text(full)}")
        self.push(Name(full))

    def tuple_of(self, count: int | None) -> None:
        items = self._since_mark() if count is None else [self._pop() for _ in range(count)][::-1]
        self.push(tuple(items))

    def append(self, several: bool) -> None:
        items = self._since_mark() if several else [self._pop()]
        target = self._top()
        if not isinstance(target, list):
            raise RefusedError("its pickle appends to an object that is not a list")
        target += items

    def set_items(self, several: bool) -> None:
        items = self._since_mark() if several else [self._pop() for _ in range(2)][::-1]
        target = self._top()
        if not isinstance(target, dict) or len(items) % 2:
            raise RefusedError("its pickle sets items of an object that is not a dictionary")
        for key, value in zip(items[::2], items[1::2], strict=True):
            match key:
                case str():
                    check_name(key)
                case int() if abs(key) < MOST_KEY:  # larger ones can be crafted to collide
                    pass
                case _:
                    raise RefusedError(f"the key {quote(key)} is neither text nor a small integer")
            if key in target:
                raise RefusedError(f"duplicate key {quote(key)}")
            target[key] = value

    def storage(self, _: None) -> None:
        match self._pop():
            case ("storage", Name(kind), str(key), str(), int(count)):
                pass
            case other:
                raise RefusedError(f"its pickle references {quote(other)}, which is not a storage")
        data = self.entries.get(f"data/{key}")
        if data is None:
            raise RefusedError(f"the storage {quote_text(key)} is missing")
        dtype = None if kind == UNTYPED else STORAGES.get(kind.removeprefix("torch."))
        if dtype is None and kind != UNTYPED:
            raise RefusedError(f"{kind} is not a storage class")
        size = count * (1 if dtype is None else DTYPES[dtype].itemsize)
        if count < 0 or size > len(data):
            raise RefusedError(
                f"the storage {quote_text(key)} declares {quote(size)} bytes but has {len(data)}"
            )
        self.push(Storage(data[:size], dtype))

    def call(self, _: None) -> None:
        arguments, name = self._pop(), self._pop()
        if not (isinstance(name, Name) and isinstance(arguments, tuple)):
            raise RefusedError("its pickle calls an object that is not a global")
        match (name.full, arguments):
            case ("collections.OrderedDict", ()):
                self.push({})
            case ("torch.Size", (tuple(size),)):
                self.push(size)
            case ("torch._utils._rebuild_parameter", (Tensor() as tensor, bool(), {})):
                self.push(tensor)
            case (
                "torch._utils._rebuild_tensor_v2",
                (Storage(dtype=str(dtype)) as storage, offset, tuple(size), tuple(stride), *_),
            ):
                self.push(_tensor(storage, dtype, offset, size, stride))
            case (
                "torch._utils._rebuild_tensor_v3",
                (
                    Storage() as storage, offset, tuple(size), tuple(stride), bool(), {},
                    Name(dtype), *_,
                ),
            ):  # fmt: skip
                self.push(_tensor(storage, dtype.removeprefix("torch."), offset, size, stride))
            case _:
                raise RefusedError(f"its pickle calls {name.full} with unsupported arguments")

    def build(self, _: None) -> None:
        """Ignore the `_metadata` of state dicts; no other state is supported."""
        state, target = self._pop(), self._top()
        if not (isinstance(state, dict) and isinstance(target, dict)):
            raise RefusedError("its pickle sets the state of an object that is not a dictionary")

    def _pop(self) -> Any:
        if not self.stack or (self.marks and len(self.stack) <= self.marks[-1]):
            raise RefusedError("its pickle pops from an empty stack")
        return self.stack.pop()

    def _top(self) -> Any:
        if not self.stack:
            raise RefusedError("its pickle reads an empty stack")
        return self.stack[-1]

    def _since_mark(self) -> list[Any]:
        if not self.marks:
            raise RefusedError("its pickle has no mark")
        begin = self.marks.pop()
        items = self.stack[begin:]
        del self.stack[begin:]
        return items


ALLOWED = {
    "collections.OrderedDict", "torch.Size", "torch._utils._rebuild_parameter",
    "torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_tensor_v3", UNTYPED,
    *(f"torch.{name}" for name in (*STORAGES, *DTYPES)),
}  # fmt: skip
"""Allow-list of globals that a pickle may reference."""


def _constant(make: Callable[[], Any]) -> Callable[[_Interpreter, Any], None]:
    return lambda interpreter, _: interpreter.push(make())


ACTIONS: dict[str, Callable[[_Interpreter, Any], None]] = {
    **dict.fromkeys(("PROTO", "FRAME"), lambda interpreter, _: None),
    **dict.fromkeys(
        (
            "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE",
            "BINUNICODE8",
        ),
        _Interpreter.push,
    ),
    "NONE": _constant(lambda: None),
    "NEWTRUE": _constant(lambda: True),
    "NEWFALSE": _constant(lambda: False),
    "EMPTY_DICT": _constant(dict),
    "EMPTY_LIST": _constant(list),
    "EMPTY_TUPLE": _constant(tuple),
    "MARK": _Interpreter.mark,
    **dict.fromkeys(("BINPUT", "LONG_BINPUT", "MEMOIZE"), _Interpreter.remember),
    **dict.fromkeys(("BINGET", "LONG_BINGET"), _Interpreter.recall),
    **dict.fromkeys(("GLOBAL", "STACK_GLOBAL"), _Interpreter.name),
    "TUPLE": lambda interpreter, _: interpreter.tuple_of(None),
    "TUPLE1": lambda interpreter, _: interpreter.tuple_of(1),
    "TUPLE2": lambda interpreter, _: interpreter.tuple_of(2),
    "TUPLE3": lambda interpreter, _: interpreter.tuple_of(3),
    "APPEND": lambda interpreter, _: interpreter.append(several=False),
    "APPENDS": lambda interpreter, _: interpreter.append(several=True),
    "SETITEM": lambda interpreter, _: interpreter.set_items(several=False),
    "SETITEMS": lambda interpreter, _: interpreter.set_items(several=True),
    "BINPERSID": _Interpreter.storage,
    "REDUCE": _Interpreter.call,
    "BUILD": _Interpreter.build,
}  # fmt: skip
"""Method of each supported pickle operation; all others are refused."""


def _tensor(storage: Storage, dtype: str, offset: Any, size: tuple, stride: tuple) -> Tensor:
    """Return a view of a storage. Raises `RefusedError` unless all its elements are inside."""
    if dtype not in DTYPES:
        raise RefusedError(f"a tensor has the unsupported dtype {dtype}")
    if len(size) != len(stride) or len(size) > MOST_AXES:
        raise RefusedError(f"a tensor has {len(size)} axes and {len(stride)} strides")
    kind = DTYPES[dtype]
    check_sizes("a tensor", (offset, *size, *stride))
    strides_of("a tensor", size, kind)
    count = math.prod(size)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    here = len(storage.data) // kind.itemsize
    if count and last >= here:
        raise RefusedError(f"a tensor of size {size} reads element {last} of a storage of {here}")
    if count > max(here, 1):
        raise RefusedError(f"a tensor of size {size} repeats the {here} elements of its storage")
    return Tensor(
        shape=size,
        dtype=kind,
        data=storage.data[offset * kind.itemsize :],
        strides=tuple(kind.itemsize * step for step in stride),
    )


def _flatten(tree: Any) -> dict[str, Tensor]:
    """Return the tensors of nested containers by their keys joined with dots."""
    found: dict[str, Tensor] = {}
    left = [(tree, "", 0)]
    nodes = items = 0
    while left:
        node, name, depth = left.pop()
        nodes += 1
        if isinstance(node, Tensor):
            if name in found:
                raise RefusedError(f"duplicate tensor {quote(name)}")
            found[name] = node
        elif isinstance(node, (dict, list, tuple)):
            items += len(node)
            if items > MOST_ITEMS or depth > DEEPEST:
                raise RefusedError("its containers are nested too deeply or reference themselves")
            for key, value in node.items() if isinstance(node, dict) else enumerate(node):
                if isinstance(value, (Tensor, dict, list, tuple, Name, Storage)):
                    inner = f"{name}.{key}" if name else str(key)
                    check_name(inner)
                    left.append((value, inner, depth + 1))
            if nodes + len(left) > MOST_TENSORS:
                raise RefusedError(f"it has more than {MOST_TENSORS:,} tensors and containers")
        elif isinstance(node, (Name, Storage)):
            raise RefusedError(
                f"{name or 'the root'} is a {type(node).__name__.lower()}, not a tensor"
            )
    return dict(reversed(found.items()))
