"""Where a run's numbers go: the console and metrics.jsonl always, other places on request."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from egosim_jax.io.run import write_text


@runtime_checkable
class Writer(Protocol):
    """Something that takes a step's numbers."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Record `values` after `step` finished updates."""
        ...


class Console:
    """One plain line a step on stderr."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Print the numbers."""
        numbers = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        print(f"step {step:>6}  {numbers}", file=sys.stderr, flush=True)


class JsonLines:
    """One JSON object a line, appended; a resumed run first drops what it is going to repeat."""

    def __init__(self, path: Path, *, resume_after: int = 0):
        self.path = path
        lines = path.read_text("utf-8").splitlines() if path.is_file() else []
        kept = [line for line in lines if json.loads(line)["step"] <= resume_after]
        write_text(path, "".join(f"{line}\n" for line in kept))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Append the numbers."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"step": step, **values}) + "\n")


class Writers:
    """Several writers as one."""

    def __init__(self, writers: Sequence[Writer]):
        self.writers = writers

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Pass the numbers on to each."""
        for writer in self.writers:
            writer.write(step, values)
