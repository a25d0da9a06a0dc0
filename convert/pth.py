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
import mmap
import pickletools
import struct
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.mapped import DTYPES, Tensor
from egosim_jax.types import InputError

STORAGES = {
    "DoubleStorage": "float64", "FloatStorage": "float32", "HalfStorage": "float16",
    "BFloat16Storage": "bfloat16", "LongStorage": "int64", "IntStorage": "int32",
    "ShortStorage": "int16", "CharStorage": "int8", "ByteStorage": "uint8", "BoolStorage": "bool",
}  # fmt: skip
UNTYPED = "torch.storage.UntypedStorage"
MOST_PICKLE, MOST_ENTRIES, DEEPEST = 64 << 20, 1 << 20, 64
"""Bytes of the pickle, entries of the zip and of all containers, and containers in containers."""
LOCAL_HEADER, LOCAL_MAGIC = 30, b"PK\x03\x04"


class RefusedError(Exception):
    """What in the pickle cannot be read, and why."""


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
    try:
        with path.open("rb") as file:
            data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
            entries = _entries(file, data)
        return _flat(_Machine(entries).run())
    except (RefusedError, zipfile.BadZipFile, ValueError, OSError, struct.error) as error:
        raise InputError(
            f"{path} is not read: {error}. Only tensors in plain containers, as torch.save writes "
            "state dicts, are; resave the weights as such, or better as safetensors."
        ) from error


def _entries(file: Any, data: memoryview) -> dict[str, memoryview]:
    """The bytes of every entry, without the folder that they all lie in."""
    if bytes(data[:2]) != b"PK":
        raise RefusedError(
            "it is no zip; files from before torch 1.6 and bare pickles are not read"
        )
    with zipfile.ZipFile(file) as archive:
        listed = archive.infolist()
    if len(listed) > MOST_ENTRIES:
        raise RefusedError(f"it has {len(listed)} entries, more than {MOST_ENTRIES}")
    if sum(entry.file_size for entry in listed) > len(data):
        raise RefusedError("its entries are larger than the file")
    found = {}
    for entry in listed:
        parts = entry.filename.split("/")
        if ".." in parts or entry.filename.startswith("/") or "\\" in entry.filename:
            raise RefusedError(f"entry {entry.filename!r} points outside")
        if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
            raise RefusedError(f"entry {entry.filename!r} is compressed or encrypted")
        name = "/".join(parts[1:])
        if name in found:
            raise RefusedError(f"entry {entry.filename!r} is there twice")
        found[name] = _stored(entry, data)
    if found.get("byteorder", b"little") != b"little":
        raise RefusedError("its numbers are big-endian")
    if "data.pkl" not in found:
        raise RefusedError("it has no data.pkl")
    return found


def _stored(entry: zipfile.ZipInfo, data: memoryview) -> memoryview:
    """The bytes of an entry; its own header repeats and lengthens what the directory says."""
    start = entry.header_offset
    header = bytes(data[start : start + LOCAL_HEADER])
    if len(header) < LOCAL_HEADER or header[:4] != LOCAL_MAGIC:
        raise RefusedError(f"entry {entry.filename!r} has no header where the directory says")
    name, extra = struct.unpack_from("<HH", header, 26)
    begin = start + LOCAL_HEADER + name + extra
    if begin + entry.file_size > len(data):
        raise RefusedError(f"entry {entry.filename!r} goes on after the file's end")
    return data[begin : begin + entry.file_size]


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
        for opcode, argument, _ in pickletools.genops(bytes(program)):
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
            raise RefusedError(f"its pickle asks for {full}")
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
            if not isinstance(key, (str, int)):
                raise RefusedError(f"a key is {type(key).__name__}, neither text nor a number")
            if key in target:
                raise RefusedError(f"the key {key!r} is there twice")
            target[key] = value

    def storage(self, _: None) -> None:
        match self._pop():
            case ("storage", Name(kind), str(key), str(), int(count)):
                pass
            case other:
                raise RefusedError(f"its pickle refers to {other!r:.60}, which is no storage")
        data = self.entries.get(f"data/{key}")
        if data is None:
            raise RefusedError(f"the storage {key} is missing")
        dtype = None if kind == UNTYPED else STORAGES.get(kind.removeprefix("torch."))
        if dtype is None and kind != UNTYPED:
            raise RefusedError(f"{kind} is no storage")
        size = count * (1 if dtype is None else np.dtype(DTYPES[dtype]).itemsize)
        if count < 0 or size > len(data):
            raise RefusedError(f"the storage {key} says {size} bytes and has {len(data)}")
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
    numbers = (offset, *size, *stride)
    if len(size) != len(stride) or not all(type(n) is int and n >= 0 for n in numbers):
        raise RefusedError(
            f"a tensor has offset {offset!r:.40}, size {size!r:.80}, stride {stride!r:.80}"
        )
    if dtype not in DTYPES:
        raise RefusedError(f"a tensor is of {dtype}")
    kind = np.dtype(DTYPES[dtype])
    count = math.prod(size)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    here = len(storage.data) // kind.itemsize
    if count and last >= here:
        raise RefusedError(f"a tensor of size {size} reaches element {last} of a storage of {here}")
    if count > max(here, 1):
        raise RefusedError(f"a tensor of size {size} repeats the {here} elements of its storage")
    return Tensor(
        shape=tuple(size),
        dtype=kind,
        data=storage.data[offset * kind.itemsize :],
        strides=tuple(kind.itemsize * step for step in stride),
    )


def _flat(tree: Any) -> dict[str, Tensor]:
    """The tensors of nested containers, by their keys joined with dots."""
    found: dict[str, Tensor] = {}
    left = [(tree, "", 0)]
    visited = 0
    while left:
        node, name, depth = left.pop()
        visited += 1
        if visited > MOST_ENTRIES or depth > DEEPEST:
            raise RefusedError("its containers are nested too deeply or repeat without end")
        if isinstance(node, Tensor):
            if name in found:
                raise RefusedError(f"there are two tensors {name!r}")
            found[name] = node
        elif isinstance(node, dict):
            left += [(v, f"{name}.{k}" if name else str(k), depth + 1) for k, v in node.items()]
        elif isinstance(node, (list, tuple)):
            left += [(v, f"{name}.{i}" if name else str(i), depth + 1) for i, v in enumerate(node)]
        elif isinstance(node, (Name, Storage)):
            raise RefusedError(
                f"{name or 'the whole'} is no tensor but {type(node).__name__.lower()}"
            )
    return dict(reversed(found.items()))
