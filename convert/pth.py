"""PyTorch's `.pth` files without PyTorch, and without running what is in them.

A `.pth` is a zip of stored entries: `NAME/data.pkl`, a pickle of dictionaries, lists and references
to tensors, and `NAME/data/KEY`, the bytes of each storage. A pickle is a program; here it is read
by a machine of its own that knows plain containers, numbers, text and tensors and nothing else. A
name that it does not know, whatever it would have done, is refused, and nothing is ever called.
Every tensor is checked against its storage before it is looked at, and stays in the mapped file
until it is.
"""

from __future__ import annotations

import math
import pickletools
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from egosim_jax.io.mapped import (
    DTYPES,
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
UNTYPED = "torch.storage.UntypedStorage"
MOST_PICKLE, MOST_STEPS, MOST_ENTRIES, DEEPEST = 16 << 20, 1 << 20, 1 << 17, 64
"""Bytes and operations of the pickle, entries of the zip, and containers in containers."""
MOST_ITEMS, MOST_KEY = 1 << 20, 1 << 31
"""Items of all containers, counted wherever they are referred to, and the highest number as key."""
END, END64_PLACE = struct.Struct("<10xH4xI2x"), struct.Struct("<8xQ4x")
END64, LOCAL = struct.Struct("<32xQ8xQ"), struct.Struct("<26xHH")
LISTED = struct.Struct("<8xHH8xIIHHH8xI")
"""What is read of the records of a zip: its end, the same in 64 bits, and each entry twice."""
STORED, NARROW = 0, 0xFFFFFFFF
"""The method of entries that are not compressed, and what stands for a number of 64 bits."""


@dataclass(frozen=True)
class Name:
    """A name that the pickle refers to; only that, never the thing."""

    full: str


@dataclass(frozen=True)
class Storage:
    """The bytes that tensors lie in."""

    data: memoryview
    dtype: str | None
    """None: the tensors say."""


def read_pth(path: Path) -> dict[str, Tensor]:
    """The tensors of a `.pth` by name; those in containers have their keys joined by dots.

    The file stays mapped as long as any of them is held. Raises `InputError` with the reason if it
    is no such file, is damaged, or holds anything but tensors, plain values and containers.
    """
    data = map_file(path)
    try:
        return _flat(_Machine(_entries(data)).run())
    except (ValueError, struct.error) as error:
        reason = str(error) if isinstance(error, RefusedError) else quote_text(str(error))
        raise InputError(
            f"{quote_path(path)} is not read: {reason}. Only tensors in plain containers, as "
            "torch.save writes state dicts, are; resave the weights as such, or better as "
            "safetensors."
        ) from error


def _entries(data: memoryview) -> dict[str, memoryview]:
    """The bytes of every entry, without the folder that they all lie in."""
    if bytes(data[:2]) != b"PK":
        raise RefusedError(
            "it is no zip; files from before torch 1.6 and bare pickles are not read"
        )
    found: dict[str, memoryview] = {}
    total = 0
    for listed in _directory(data):
        total += listed.size
        if total > len(data):
            raise RefusedError("its entries are larger than the file")
        parts = listed.name.split("/")
        if ".." in parts or listed.name.startswith("/") or "\\" in listed.name:
            raise RefusedError(f"entry {quote(listed.name)} points outside")
        if listed.method != STORED or listed.flags & 1:
            raise RefusedError(f"entry {quote(listed.name)} is compressed or encrypted")
        name = "/".join(parts[1:])
        if name in found:
            raise RefusedError(f"entry {quote(listed.name)} is there twice")
        found[name] = _stored(listed, data)
    if found.get("byteorder", b"little") != b"little":
        raise RefusedError("its numbers are big-endian")
    if "data.pkl" not in found:
        raise RefusedError("it has no data.pkl")
    return found


class Entry(NamedTuple):
    """What the directory of a zip says of an entry."""

    name: str
    flags: int
    method: int
    size: int
    offset: int


def _directory(data: memoryview) -> Iterator[Entry]:
    """The entries that a zip says it has, as many as it says, and no more than `MOST_ENTRIES`."""
    tail = max(0, len(data) - END.size - 0xFFFF)
    end = bytes(data[tail:]).rfind(b"PK\5\6") + tail
    if end < tail or end + END.size > len(data):
        raise RefusedError("it is a zip without its end: it was cut off")
    count, place = END.unpack_from(data, end)
    if end >= END64_PLACE.size and data[end - END64_PLACE.size :][:4] == b"PK\6\7":
        (wide,) = END64_PLACE.unpack_from(data, end - END64_PLACE.size)
        if wide + END64.size > len(data) or data[wide : wide + 4] != b"PK\6\6":
            raise RefusedError("its directory is not where it says")
        count, place = END64.unpack_from(data, wide)
    if count > MOST_ENTRIES:
        raise RefusedError(f"it has {count:,} entries, more than {MOST_ENTRIES:,}")
    for _ in range(count):
        if place + LISTED.size > len(data) or data[place : place + 4] != b"PK\1\2":
            raise RefusedError("its directory is damaged")
        flags, method, packed, size, name, extra, comment, offset = LISTED.unpack_from(data, place)
        names = place + LISTED.size
        after = names + name + extra + comment
        if after > len(data):
            raise RefusedError("its directory is damaged")
        more = _wide(bytes(data[names + name : names + name + extra]))
        size = next(more, size) if size == NARROW else size
        packed = next(more, packed) if packed == NARROW else packed
        offset = next(more, offset) if offset == NARROW else offset
        text = bytes(data[names : names + name]).decode("utf-8", "replace")
        if packed != size and method == STORED:
            raise RefusedError(f"entry {quote(text)} has two sizes")
        yield Entry(text, flags, method, size, offset)
        place = after


def _wide(extra: bytes) -> Iterator[int]:
    """The numbers of an entry that do not fit in 32 bits."""
    while len(extra) >= 4:
        kind, size = struct.unpack_from("<HH", extra)
        if kind == 1:
            yield from (number for (number,) in struct.iter_unpack("<Q", extra[4 : 4 + size & ~7]))
        extra = extra[4 + size :]


def _stored(entry: Entry, data: memoryview) -> memoryview:
    """The bytes of an entry; its own header repeats and lengthens what the directory says."""
    if entry.offset + LOCAL.size > len(data) or data[entry.offset :][:4] != b"PK\3\4":
        raise RefusedError(f"entry {quote(entry.name)} has no header where the directory says")
    name, extra = LOCAL.unpack_from(data, entry.offset)
    begin = entry.offset + LOCAL.size + name + extra
    if begin + entry.size > len(data):
        raise RefusedError(f"entry {quote(entry.name)} goes on after the file's end")
    return data[begin : begin + entry.size]


class _Machine:
    """A pickle machine that makes containers, numbers, text and tensors, and calls nothing."""

    def __init__(self, entries: Mapping[str, memoryview]):
        self.entries = entries
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def run(self) -> Any:
        """What the pickle describes."""
        program = self.entries["data.pkl"]
        if len(program) > MOST_PICKLE:
            raise RefusedError(f"its pickle has {len(program)} bytes, more than {MOST_PICKLE}")
        for step, (opcode, argument, _) in enumerate(pickletools.genops(bytes(program))):
            if step == MOST_STEPS:
                raise RefusedError(f"its pickle has more than {MOST_STEPS:,} operations")
            if opcode.name == "STOP":
                return self._pop()
            action = ACTIONS.get(opcode.name)
            if action is None:
                raise RefusedError(f"its pickle has the operation {opcode.name}")
            action(self, argument)
        raise RefusedError("its pickle does not stop")

    def push(self, value: Any) -> None:
        self.stack.append(value)

    def mark(self, _: None) -> None:
        self.marks.append(len(self.stack))

    def remember(self, number: int | None) -> None:
        self.memo[len(self.memo) if number is None else number] = self._top()

    def recall(self, number: int) -> None:
        if number not in self.memo:
            raise RefusedError(f"its pickle recalls {number}, which it has not made")
        self.push(self.memo[number])

    def name(self, text: str | None) -> None:
        if text is None:
            last, module = self._pop(), self._pop()
            if not (isinstance(last, str) and isinstance(module, str)):
                raise RefusedError("its pickle makes up a name")
            text = f"{module} {last}"
        full = text.replace(" ", ".", 1)
        if full not in KNOWN:
            raise RefusedError(f"its pickle asks for {quote_text(full)}")
        self.push(Name(full))

    def tuple_of(self, count: int | None) -> None:
        items = self._since_mark() if count is None else [self._pop() for _ in range(count)][::-1]
        self.push(tuple(items))

    def append(self, several: bool) -> None:
        items = self._since_mark() if several else [self._pop()]
        target = self._top()
        if not isinstance(target, list):
            raise RefusedError("its pickle appends to what is no list")
        target += items

    def set_items(self, several: bool) -> None:
        items = self._since_mark() if several else [self._pop() for _ in range(2)][::-1]
        target = self._top()
        if not isinstance(target, dict) or len(items) % 2:
            raise RefusedError("its pickle sets items of what is no dictionary")
        for key, value in zip(items[::2], items[1::2], strict=True):
            match key:
                case str():
                    check_name(key)
                case int() if abs(key) < MOST_KEY:  # wider ones may be made to collide
                    pass
                case _:
                    raise RefusedError(f"a key is {quote(key)}, neither text nor a usual number")
            if key in target:
                raise RefusedError(f"the key {quote(key)} is there twice")
            target[key] = value

    def storage(self, _: None) -> None:
        match self._pop():
            case ("storage", Name(kind), str(key), str(), int(count)):
                pass
            case other:
                raise RefusedError(f"its pickle refers to {quote(other)}, which is no storage")
        data = self.entries.get(f"data/{key}")
        if data is None:
            raise RefusedError(f"the storage {quote_text(key)} is missing")
        dtype = None if kind == UNTYPED else STORAGES.get(kind.removeprefix("torch."))
        if dtype is None and kind != UNTYPED:
            raise RefusedError(f"{kind} is no storage")
        size = count * (1 if dtype is None else np.dtype(DTYPES[dtype]).itemsize)
        if count < 0 or size > len(data):
            raise RefusedError(
                f"the storage {quote_text(key)} says {quote(size)} bytes and has {len(data)}"
            )
        self.push(Storage(data[:size], dtype))

    def call(self, _: None) -> None:
        arguments, name = self._pop(), self._pop()
        if not (isinstance(name, Name) and isinstance(arguments, tuple)):
            raise RefusedError("its pickle calls what is no name")
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
                raise RefusedError(f"its pickle calls {name.full} with what it does not take")

    def build(self, _: None) -> None:
        """A state dict's `_metadata` is left out; nothing else has a state."""
        state, target = self._pop(), self._top()
        if not (isinstance(state, dict) and isinstance(target, dict)):
            raise RefusedError("its pickle sets the state of what is no dictionary")

    def _pop(self) -> Any:
        if not self.stack or (self.marks and len(self.stack) <= self.marks[-1]):
            raise RefusedError("its pickle takes what it has not made")
        return self.stack.pop()

    def _top(self) -> Any:
        if not self.stack:
            raise RefusedError("its pickle uses what it has not made")
        return self.stack[-1]

    def _since_mark(self) -> list[Any]:
        if not self.marks:
            raise RefusedError("its pickle has no mark")
        begin = self.marks.pop()
        items = self.stack[begin:]
        del self.stack[begin:]
        return items


KNOWN = {
    "collections.OrderedDict", "torch.Size", "torch._utils._rebuild_parameter",
    "torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_tensor_v3", UNTYPED,
    *(f"torch.{name}" for name in (*STORAGES, *DTYPES)),
}  # fmt: skip
"""All that a pickle may name."""


def _constant(make: Callable[[], Any]) -> Callable[[_Machine, Any], None]:
    return lambda machine, _: machine.push(make())


ACTIONS: dict[str, Callable[[_Machine, Any], None]] = {
    **dict.fromkeys(("PROTO", "FRAME"), lambda machine, _: None),
    **dict.fromkeys(
        (
            "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE",
            "BINUNICODE8",
        ),
        _Machine.push,
    ),
    "NONE": _constant(lambda: None),
    "NEWTRUE": _constant(lambda: True),
    "NEWFALSE": _constant(lambda: False),
    "EMPTY_DICT": _constant(dict),
    "EMPTY_LIST": _constant(list),
    "EMPTY_TUPLE": _constant(tuple),
    "MARK": _Machine.mark,
    **dict.fromkeys(("BINPUT", "LONG_BINPUT", "MEMOIZE"), _Machine.remember),
    **dict.fromkeys(("BINGET", "LONG_BINGET"), _Machine.recall),
    **dict.fromkeys(("GLOBAL", "STACK_GLOBAL"), _Machine.name),
    "TUPLE": lambda machine, _: machine.tuple_of(None),
    "TUPLE1": lambda machine, _: machine.tuple_of(1),
    "TUPLE2": lambda machine, _: machine.tuple_of(2),
    "TUPLE3": lambda machine, _: machine.tuple_of(3),
    "APPEND": lambda machine, _: machine.append(several=False),
    "APPENDS": lambda machine, _: machine.append(several=True),
    "SETITEM": lambda machine, _: machine.set_items(several=False),
    "SETITEMS": lambda machine, _: machine.set_items(several=True),
    "BINPERSID": _Machine.storage,
    "REDUCE": _Machine.call,
    "BUILD": _Machine.build,
}  # fmt: skip
"""What each operation of a pickle does; those that are missing are refused."""


def _tensor(storage: Storage, dtype: str, offset: Any, size: tuple, stride: tuple) -> Tensor:
    """A tensor of a storage, if all its elements lie there."""
    if dtype not in DTYPES:
        raise RefusedError(f"a tensor is of {dtype}")
    if len(size) != len(stride) or len(size) > MOST_AXES:
        raise RefusedError(f"a tensor has {len(size)} axes and {len(stride)} strides")
    kind = np.dtype(DTYPES[dtype])
    check_sizes("a tensor", (offset, *size, *stride))
    strides_of("a tensor", size, kind)
    count = math.prod(size)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    here = len(storage.data) // kind.itemsize
    if count and last >= here:
        raise RefusedError(f"a tensor of size {size} reaches element {last} of a storage of {here}")
    if count > max(here, 1):
        raise RefusedError(f"a tensor of size {size} repeats the {here} elements of its storage")
    return Tensor(
        shape=size,
        dtype=kind,
        data=storage.data[offset * kind.itemsize :],
        strides=tuple(kind.itemsize * step for step in stride),
    )


def _flat(tree: Any) -> dict[str, Tensor]:
    """The tensors of nested containers, by their keys joined with dots."""
    found: dict[str, Tensor] = {}
    left = [(tree, "", 0)]
    nodes = items = 0
    while left:
        node, name, depth = left.pop()
        nodes += 1
        if isinstance(node, Tensor):
            if name in found:
                raise RefusedError(f"there are two tensors {quote(name)}")
            found[name] = node
        elif isinstance(node, (dict, list, tuple)):
            items += len(node)
            if items > MOST_ITEMS or depth > DEEPEST:
                raise RefusedError("its containers are nested too deeply or repeat without end")
            for key, value in node.items() if isinstance(node, dict) else enumerate(node):
                if isinstance(value, (Tensor, dict, list, tuple, Name, Storage)):
                    inner = f"{name}.{key}" if name else str(key)
                    check_name(inner)
                    left.append((value, inner, depth + 1))
            if nodes + len(left) > MOST_TENSORS:
                raise RefusedError(f"it has more than {MOST_TENSORS:,} tensors and containers")
        elif isinstance(node, (Name, Storage)):
            raise RefusedError(
                f"{name or 'the whole'} is no tensor but {type(node).__name__.lower()}"
            )
    return dict(reversed(found.items()))
