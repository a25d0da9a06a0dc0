"""Interpreter of pickles that calls no function, imports no module and builds only plain values.

Our own code, because `pickle.Unpickler` limits neither operations nor nesting nor memory.

A pickle is a program for a stack machine. This machine supports containers, numbers and text. A
global on the allow-list becomes a `Name`; any other is refused. A subclass builds the values that
calls of globals would create (`pth.py` for torch, `pickled_arrays.py` for NumPy).
"""

from __future__ import annotations

import pickletools
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from egosim_jax.io.bounded import quote, quote_path, quote_text
from egosim_jax.io.mapped import MAX_TENSORS, RefusedError, check_name
from egosim_jax.types import InputError

MAX_PICKLE, MAX_STEPS, MAX_DEPTH = 16 << 20, 1 << 20, 64
"""Limits: bytes and operations of the pickle, depth of nested containers."""
MAX_ITEMS, MAX_KEY = 1 << 20, 1 << 31
"""Limits: items of all containers, counted at every reference, and magnitude of integer keys."""

Leaf = TypeVar("Leaf")


class Opaque:
    """Intermediate object of a pickle, which must not remain in the result."""


@dataclass(frozen=True)
class Name(Opaque):
    """Dotted name of a global that the pickle references; the object is never loaded."""

    full: str


class Interpreter:
    """Pickle interpreter for containers, numbers and text; subclasses add the values of a library.

    Raises `RefusedError` for every operation, global and call that it does not support.
    """

    allowed: ClassVar[frozenset[str]] = frozenset({"collections.OrderedDict"})
    """Dotted names of the globals that a pickle may reference."""
    actions: ClassVar[Mapping[str, Callable[[Interpreter, Any], None]]]
    """Method of each supported pickle operation; all others are refused."""
    max_bytes: ClassVar[int] = MAX_PICKLE

    def __init__(self, program: bytes | memoryview):
        self.program = program
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def called(self, name: str, arguments: tuple) -> Any:
        """Return the value that a call of a global creates."""
        if (name, arguments) == ("collections.OrderedDict", ()):
            return {}
        raise RefusedError(f"its pickle calls {name} with unsupported arguments")

    def referenced(self, identity: Any) -> Any:
        """Return the object outside of the pickle that a persistent id references."""
        raise RefusedError(f"its pickle references {quote(identity)} outside of it")

    def set_state(self, target: Any, state: Any) -> None:
        """Set the state of an object; states of dictionaries, such as `_metadata`, are ignored."""
        if not (isinstance(state, dict) and isinstance(target, dict)):
            raise RefusedError("its pickle sets the state of an object that is not a dictionary")

    def run(self) -> Any:
        """Return the object that the pickle describes."""
        if len(self.program) > self.max_bytes:
            raise RefusedError(
                f"its pickle has {len(self.program):,} bytes; the limit is {self.max_bytes:,}"
            )
        for step, (opcode, argument, _) in enumerate(pickletools.genops(bytes(self.program))):
            if step == MAX_STEPS:
                raise RefusedError(f"its pickle has more than {MAX_STEPS:,} operations")
            if opcode.name == "STOP":
                return self._pop()
            action = self.actions.get(opcode.name)
            if action is None:
                raise RefusedError(f"its pickle uses the unsupported operation {opcode.name}")
            action(self, argument)
        raise RefusedError("its pickle has no STOP")

    def push(self, value: Any) -> None:
        """Put a value on the stack."""
        self.stack.append(value)

    def _mark(self, _: None) -> None:
        self.marks.append(len(self.stack))

    def _remember(self, number: int | None) -> None:
        self.memo[len(self.memo) if number is None else number] = self._top()

    def _recall(self, number: int) -> None:
        if number not in self.memo:
            raise RefusedError(f"its pickle reads memo {number}, which is not set")
        self.push(self.memo[number])

    def _name(self, text: str | None) -> None:
        if text is None:
            last, module = self._pop(), self._pop()
            if not (isinstance(last, str) and isinstance(module, str)):
                raise RefusedError("its pickle references a global whose name is not text")
            text = f"{module} {last}"
        full = text.replace(" ", ".", 1)
        if full not in self.allowed:
            raise RefusedError(f"its pickle references the disallowed global {quote_text(full)}")
        self.push(Name(full))

    def _tuple_of(self, count: int | None) -> None:
        items = self._since_mark() if count is None else [self._pop() for _ in range(count)][::-1]
        self.push(tuple(items))

    def _append(self, several: bool) -> None:
        items = self._since_mark() if several else [self._pop()]
        target = self._top()
        if not isinstance(target, list):
            raise RefusedError("its pickle appends to an object that is not a list")
        target += items

    def _set_items(self, several: bool) -> None:
        items = self._since_mark() if several else [self._pop() for _ in range(2)][::-1]
        target = self._top()
        if not isinstance(target, dict) or len(items) % 2:
            raise RefusedError("its pickle sets items of an object that is not a dictionary")
        for key, value in zip(items[::2], items[1::2], strict=True):
            match key:
                case str():
                    check_name(key)
                case int() if abs(key) < MAX_KEY:  # larger ones can be crafted to collide
                    pass
                case _:
                    raise RefusedError(f"the key {quote(key)} is neither text nor a small integer")
            if key in target:
                raise RefusedError(f"duplicate key {quote(key)}")
            target[key] = value

    def _refer(self, _: None) -> None:
        self.push(self.referenced(self._pop()))

    def _call(self, _: None) -> None:
        arguments, name = self._pop(), self._pop()
        if not (isinstance(name, Name) and isinstance(arguments, tuple)):
            raise RefusedError("its pickle calls an object that is not a global")
        self.push(self.called(name.full, arguments))

    def _build(self, _: None) -> None:
        state = self._pop()
        self.set_state(self._top(), state)

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


def _constant(make: Callable[[], Any]) -> Callable[[Interpreter, Any], None]:
    return lambda interpreter, _: interpreter.push(make())


ACTIONS: dict[str, Callable[[Interpreter, Any], None]] = {
    **dict.fromkeys(("PROTO", "FRAME"), lambda interpreter, _: None),
    **dict.fromkeys(
        (
            "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE",
            "BINUNICODE8",
        ),
        Interpreter.push,
    ),
    "NONE": _constant(lambda: None),
    "NEWTRUE": _constant(lambda: True),
    "NEWFALSE": _constant(lambda: False),
    "EMPTY_DICT": _constant(dict),
    "EMPTY_LIST": _constant(list),
    "EMPTY_TUPLE": _constant(tuple),
    "MARK": Interpreter._mark,
    **dict.fromkeys(("BINPUT", "LONG_BINPUT", "MEMOIZE"), Interpreter._remember),
    **dict.fromkeys(("BINGET", "LONG_BINGET"), Interpreter._recall),
    **dict.fromkeys(("GLOBAL", "STACK_GLOBAL"), Interpreter._name),
    "TUPLE": lambda interpreter, _: interpreter._tuple_of(None),
    "TUPLE1": lambda interpreter, _: interpreter._tuple_of(1),
    "TUPLE2": lambda interpreter, _: interpreter._tuple_of(2),
    "TUPLE3": lambda interpreter, _: interpreter._tuple_of(3),
    "APPEND": lambda interpreter, _: interpreter._append(several=False),
    "APPENDS": lambda interpreter, _: interpreter._append(several=True),
    "SETITEM": lambda interpreter, _: interpreter._set_items(several=False),
    "SETITEMS": lambda interpreter, _: interpreter._set_items(several=True),
    "BINPERSID": Interpreter._refer,
    "REDUCE": Interpreter._call,
    "BUILD": Interpreter._build,
}  # fmt: skip
Interpreter.actions = ACTIONS


@contextmanager
def refusing_damage(path: Path, fix: str) -> Iterator[None]:
    """Turn the exceptions of a damaged or hostile pickle into `InputError`."""
    try:
        yield
    except (ValueError, struct.error, IndexError, TypeError, KeyError) as error:
        reason = str(error) if isinstance(error, RefusedError) else quote_text(str(error))
        raise InputError(f"{quote_path(path)} cannot be read: {reason}. {fix}") from error


def flatten(tree: Any, kind: type[Leaf]) -> dict[str, Leaf]:
    """Return the leaves of one kind in nested containers, by their keys joined with dots."""
    found: dict[str, Leaf] = {}
    left = [(tree, "", 0)]
    nodes = items = 0
    while left:
        node, name, depth = left.pop()
        nodes += 1
        if isinstance(node, kind):
            if name in found:
                raise RefusedError(f"duplicate tensor {quote(name)}")
            found[name] = node
        elif isinstance(node, (dict, list, tuple)):
            items += len(node)
            if items > MAX_ITEMS or depth > MAX_DEPTH:
                raise RefusedError("its containers are nested too deeply or reference themselves")
            for key, value in node.items() if isinstance(node, dict) else enumerate(node):
                if isinstance(value, (kind, dict, list, tuple, Opaque)):
                    inner = f"{name}.{key}" if name else str(key)
                    check_name(inner)
                    left.append((value, inner, depth + 1))
            if nodes + len(left) > MAX_TENSORS:
                raise RefusedError(f"it has more than {MAX_TENSORS:,} tensors and containers")
        elif isinstance(node, Opaque):
            raise RefusedError(
                f"{name or 'the root'} is a {type(node).__name__.lower()}, not a tensor"
            )
    return dict(reversed(found.items()))
