"""Memory traffic, collectives and largest arrays of a compiled program, from its HLO text.

The text is a list of computations, each a list of instructions

    %name = type opcode(%operand, ...), attribute=value, ..., metadata={op_name="..."}

A loop's trip count is the compiler's, or else the bound in the loop's condition. A fusion's
instructions are one pass over memory; all others read their operands and write their results.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import prod

BITS = {
    "pred": 8, "s4": 4, "u4": 4, "s8": 8, "u8": 8, "s16": 16, "u16": 16, "s32": 32, "u32": 32,
    "s64": 64, "u64": 64, "f8e4m3fn": 8, "f8e5m2": 8, "bf16": 16, "f16": 16, "f32": 32, "f64": 64,
    "c64": 64, "c128": 128,
}  # fmt: skip
"""Bits per value of each XLA type."""
COLLECTIVES = (
    "all-gather", "reduce-scatter", "all-reduce", "all-to-all", "collective-permute",
    "ragged-all-to-all", "collective-broadcast",
)  # fmt: skip
FREE = {
    "parameter", "constant", "tuple", "get-tuple-element", "bitcast", "while", "conditional",
    "call", "after-all", "partition-id", "replica-id", "iota", "optimization-barrier",
}  # fmt: skip
"""Opcodes without memory traffic."""

_ARRAY = re.compile(r"\b([a-z]+\d*\w*)\[([\d,]*)\]")
_COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.\-]+) .*\{$")
_NAME = re.compile(r"^\s+(ROOT )?%?([\w.\-]+) = (.*)$")
_OPERAND = re.compile(r"%([\w.\-]+)")
_CALLED = re.compile(r"\b(?:body|calls|to_apply|branch_computations)=(\{[^}]*\}|%?[\w.\-]+)")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')
_OP_NAME = re.compile(r'op_name="([^"]*)"')


@dataclass(frozen=True)
class Instruction:
    """One HLO instruction."""

    name: str
    type: str
    opcode: str
    operands: tuple[str, ...]
    attributes: str
    root: bool

    @property
    def bytes(self) -> int:
        """Return the bytes of its result."""
        return _bytes(self.type)

    @property
    def source(self) -> str:
        """Return the traced operation that it comes from; empty if the compiler added it."""
        found = _OP_NAME.search(self.attributes)
        return found.group(1) if found else ""


@dataclass(frozen=True)
class CollectiveTraffic:
    """Traffic of one kind of collective, on one device."""

    count: int
    """Number of executions of the instruction."""
    bytes: float
    """Bytes that the device sends."""


@dataclass(frozen=True)
class LargeArray:
    """A large array, or several equal ones."""

    bytes: int
    """Bytes of one array."""
    shape: str
    """Dtype and shape in XLA's notation."""
    source: str
    """Operation that produces it, or the argument."""
    count: int
    """Number of equal arrays."""


@dataclass(frozen=True)
class HloModule:
    """The computations of a compiled HLO module, by name."""

    computations: Mapping[str, Mapping[str, Instruction]]
    entry: str

    @classmethod
    def read(cls, text: str) -> HloModule:
        """Parse the text of `Compiled.as_text`."""
        computations: dict[str, dict[str, Instruction]] = {}
        entry, current = "", {}
        for line in text.splitlines():
            if found := _COMPUTATION.match(line):
                current = computations.setdefault(found.group(2), {})
                entry = found.group(2) if found.group(1) else entry
            elif found := _NAME.match(line):
                instruction = _instruction(found.group(2), found.group(3), bool(found.group(1)))
                current[instruction.name] = instruction
        return cls(computations, entry)

    @cached_property
    def runs(self) -> Mapping[str, int]:
        """Return the number of executions of each computation outside fusions."""
        runs: dict[str, int] = defaultdict(int)

        def walk(name: str, times: int) -> None:
            runs[name] += times
            for instruction in self.computations[name].values():
                if instruction.opcode in ("while", "conditional", "call", "async-start"):
                    once = 1 if instruction.opcode != "while" else self._trips(instruction)
                    for called in _called(instruction):
                        walk(called, times * once)

        walk(self.entry, 1)
        return runs

    def collectives(self) -> dict[str, CollectiveTraffic]:
        """Return the traffic of one device by kind of collective."""
        found: dict[str, CollectiveTraffic] = {}
        for computation, times in self.runs.items():
            for instruction, sent in self._sent_in(computation):
                kind = instruction.opcode.removesuffix("-start")
                have = found.get(kind, CollectiveTraffic(0, 0.0))
                found[kind] = CollectiveTraffic(have.count + times, have.bytes + times * sent)
        return found

    def traffic(self) -> float:
        """Return the bytes that a device reads from its memory and writes to it."""
        return float(
            sum(
                times * self._passes(instruction, name)
                for name, times in self.runs.items()
                for instruction in self.computations[name].values()
            )
        )

    def largest(self, count: int) -> list[LargeArray]:
        """Return the largest arguments and results of instructions, equal ones grouped."""
        equal: dict[tuple[str, str], list[Instruction]] = defaultdict(list)
        for name in self.runs:
            for instruction in self.computations[name].values():
                given = instruction.opcode == "parameter" and name == self.entry
                if (given or self._makes(instruction)) and not instruction.type.startswith("("):
                    kind = instruction.type.partition("{")[0]
                    equal[kind, instruction.source].append(instruction)
        arrays = [
            LargeArray(group[0].bytes, kind, source, len(group))
            for (kind, source), group in equal.items()
        ]
        return sorted(arrays, key=lambda array: (-array.bytes, array.source))[:count]

    def _sent_in(self, computation: str) -> Iterator[tuple[Instruction, float]]:
        """Yield each collective of a computation and its fusions, and the bytes that it sends."""
        have = self.computations[computation]
        for instruction in have.values():
            if instruction.opcode == "fusion":
                for called in _called(instruction):
                    yield from self._sent_in(called)
            elif (kind := instruction.opcode.removesuffix("-start")) in COLLECTIVES:
                operands = sum(have[name].bytes for name in instruction.operands)
                yield instruction, _sent(kind, operands, _group(instruction.attributes))

    def _makes(self, instruction: Instruction) -> bool:
        """Return whether its result is a new array, not a view or an update of another."""
        if instruction.opcode == "fusion":
            inner = self.computations[_called(instruction)[0]]
            (root,) = (i for i in inner.values() if i.root)
            while root.opcode == "bitcast":
                root = inner[root.operands[0]]
            return root.opcode != "dynamic-update-slice"
        changed = instruction.opcode == "dynamic-update-slice"
        return not (changed or instruction.opcode in FREE or instruction.opcode.endswith("-done"))

    def _trips(self, loop: Instruction) -> int:
        if found := _TRIPS.search(loop.attributes):
            return int(found.group(1))
        condition = re.search(r"condition=%?([\w.\-]+)", loop.attributes)
        bounds = [
            int(found.group(1))
            for instruction in self.computations[condition.group(1) if condition else ""].values()
            if instruction.opcode == "constant"
            and (found := re.match(r"\((\d+)\)", instruction.attributes))
        ]
        return max(bounds, default=1)

    def _passes(self, instruction: Instruction, computation: str) -> int:
        """Return the bytes that an instruction reads and writes."""
        opcode = instruction.opcode
        if opcode in FREE or opcode.endswith("-done"):
            return 0
        have = self.computations[computation]
        operands = [have[name].bytes for name in instruction.operands if name in have]
        if opcode == "dynamic-slice":
            return 2 * instruction.bytes
        if opcode == "dynamic-update-slice":
            return 2 * operands[1]
        if opcode == "fusion":
            (inner,) = _called(instruction)
            return self._fused(self.computations[inner], instruction.bytes)
        # The start of a collective or copy returns its operands and the result.
        given = sum(operands) if opcode.endswith("-start") and instruction.type[0] == "(" else 0
        return sum(operands) + instruction.bytes - given

    def _fused(self, inner: Mapping[str, Instruction], out: int) -> int:
        """Return the bytes of a fusion; for a sliced or updated array, only the slice counts."""
        users: dict[str, list[Instruction]] = defaultdict(list)
        for instruction in inner.values():
            for name in instruction.operands:
                users[name].append(instruction)
        read = 0
        for parameter in inner.values():
            if parameter.opcode == "parameter":
                read += _read(parameter, users)
        changed = [i for i in inner.values() if i.opcode == "dynamic-update-slice"]
        for update in changed:
            out -= update.bytes - inner[update.operands[1]].bytes
        return read + max(out, 0)


def _read(value: Instruction, users: Mapping[str, list[Instruction]]) -> int:
    """Return the bytes of a value that a fusion reads."""
    used = users[value.name]
    first = all(user.operands[0] == value.name for user in used)
    if used and first and all(user.opcode in ("dynamic-slice", "gather") for user in used):
        return sum(user.bytes for user in used)
    if used and first and all(user.opcode == "dynamic-update-slice" for user in used):
        return 0
    if len(used) == 1 and used[0].opcode in ("bitcast", "copy") and not used[0].root:
        return _read(used[0], users)
    return value.bytes


def _instruction(name: str, rest: str, root: bool) -> Instruction:
    end = _closing(rest, 0) + 1 if rest.startswith("(") else rest.index(" ")
    kind, rest = rest[:end], rest[end:].lstrip()
    opcode, _, _ = rest.partition("(")
    end = _closing(rest, len(opcode)) + 1
    given = rest[len(opcode) : end]
    # A constant has its value in place of operands.
    attributes = given if opcode == "constant" else rest[end:]
    operands = () if opcode == "constant" else tuple(_OPERAND.findall(given))
    return Instruction(name, kind, opcode, operands, attributes, root)


def _closing(text: str, start: int) -> int:
    depth = 0
    for place in range(start, len(text)):
        depth += (text[place] == "(") - (text[place] == ")")
        if depth == 0:
            return place
    raise ValueError(f"No closing parenthesis in {text!r}")


def _called(instruction: Instruction) -> list[str]:
    found = _CALLED.findall(instruction.attributes)
    return [name.strip(" %") for names in found for name in names.strip("{}").split(",")]


def _bytes(type_: str) -> int:
    return sum(
        -(-BITS.get(kind, 0) * prod(int(n) for n in sizes.split(",") if n) // 8)
        for kind, sizes in _ARRAY.findall(type_)
    )


def _group(attributes: str) -> int:
    """Return the number of devices in a group of a collective."""
    if found := re.search(r"replica_groups=mesh\[([^\]]*)\] \{([^}]*)\}", attributes):
        sizes = dict(re.findall(r"'(\w+)'=(\d+)", found.group(1)))
        return prod(int(sizes[axis]) for axis in re.findall(r"'(\w+)'", found.group(2)))
    if found := re.search(r"replica_groups=\[\d+,(\d+)\]", attributes):
        return int(found.group(1))
    if found := re.search(r"replica_groups=\{\{([\d,]*)\}", attributes):
        return len(found.group(1).split(","))
    return 2


def _sent(kind: str, operands: int, group: int) -> float:
    """Return the bytes that each device of a group sends, in a ring."""
    if kind == "collective-permute":
        return float(operands)
    total = operands * group if kind == "all-gather" else operands
    return (2 if kind == "all-reduce" else 1) * total * (group - 1) / group
