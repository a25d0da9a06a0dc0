"""Where a run's numbers go: the console and metrics.jsonl always, other places on request."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Protocol, runtime_checkable

from egosim_jax.io.atomic import append_line
from egosim_jax.io.run import write_text
from egosim_jax.io.untrusted import read_lines
from egosim_jax.types import InputError


@runtime_checkable
class Writer(Protocol):
    """Something that takes a step's numbers."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Record `values` after `step` finished updates."""
        ...

    def close(self) -> None:
        """Record what has not been yet."""
        ...


class Console:
    """Numbers on stderr: a live line below the last ones on a terminal, plain lines otherwise."""

    def __init__(self, steps: int):
        from rich.console import Console as Terminal
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

        columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"))
        terminal = Terminal(file=sys.stderr)
        self._live = Progress(*columns, console=terminal) if terminal.is_terminal else None
        if self._live is not None:
            self._task = self._live.add_task("", total=steps)
            self._live.start()

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Print the numbers; those of validations stay on a terminal."""
        numbers = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        if self._live is None:
            print(f"step {step:>6}  {numbers}", file=sys.stderr, flush=True)
        elif "loss" in values:
            self._live.update(self._task, completed=step, description=numbers)
        else:
            self._live.print(f"step {step:>6}  {numbers}")

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._live is not None:
            self._live.stop()


class JsonLines:
    """One JSON object a line, appended; a resumed run first drops what it is going to repeat."""

    def __init__(self, path: Path, *, resume_after: int = 0):
        self.path = path
        kept = []
        for number, line in read_lines(path) if path.exists() else ():
            if not isinstance(line, dict) or type(line.get("step")) is not int:
                raise InputError(f"{path}, line {number} is of no step. Restore or remove it.")
            if line["step"] <= resume_after:
                kept.append(json.dumps(line))
        write_text(path, "".join(f"{line}\n" for line in kept))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Append the numbers."""
        append_line(self.path, {"step": step, **values})

    def close(self) -> None:
        """Nothing is left: every line is written at once."""


class TensorBoard:
    """Scalars for TensorBoard, by tensorboardX; a resumed run hides what it is going to repeat."""

    def __init__(self, folder: Path, *, resume_after: int = 0):
        self._writer = _package("tensorboard").SummaryWriter(
            str(folder), purge_step=resume_after + 1
        )

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Add a scalar for each number."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Write out."""
        self._writer.close()


class WandB:
    """A run of Weights & Biases; its id lies in the run's folder, so that resuming goes on in it.

    Where it goes and how one logs in is for W&B's own environment variables to say.
    """

    def __init__(self, folder: Path, *, project: str, name: str):
        wandb = _package("wandb")
        path = folder / "wandb_id.txt"
        if not path.exists():
            write_text(path, wandb.util.generate_id())
        known = path.read_text("utf-8")
        self._run = wandb.init(
            project=project, name=name, id=known, resume="allow", dir=str(folder)
        )

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Log the numbers."""
        self._run.log(dict(values), step=step)

    def close(self) -> None:
        """Finish the upload."""
        self._run.finish()


class Writers:
    """Several writers as one."""

    def __init__(self, writers: Sequence[Writer]):
        self.writers = writers

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Pass the numbers on to each."""
        for writer in self.writers:
            writer.write(step, values)

    def close(self) -> None:
        """Close each."""
        for writer in self.writers:
            writer.close()


EXTRAS = {"tensorboard": "tensorboardX", "wandb": "wandb"}
"""Places that need a package of an extra of the same name."""


def check_installed(extra: str) -> None:
    """Raise `InputError` if the package of an extra is not installed."""
    if sys.modules.get(EXTRAS[extra]) is None and find_spec(EXTRAS[extra]) is None:
        raise InputError(
            f"{EXTRAS[extra]} is not installed: pip install 'egosim-jax[{extra}]'. "
            f"(--training.{extra})"
        )


def _package(extra: str) -> ModuleType:
    check_installed(extra)
    return import_module(EXTRAS[extra])
