"""Metric writers: the console, metrics.jsonl, TensorBoard and Weights & Biases."""

from __future__ import annotations

import json
import secrets
import sys
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from types import ModuleType
from typing import Protocol, runtime_checkable

from egosim_jax.io.atomic import append_line
from egosim_jax.io.bounded import read_json, read_lines
from egosim_jax.io.run import write_text
from egosim_jax.types import InputError


@runtime_checkable
class Writer(Protocol):
    """Interface of a metric writer."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Write the metrics of `step`, the number of finished updates."""
        ...

    def close(self) -> None:
        """Flush the metrics and release the writer's resources."""
        ...


class Console:
    """Metrics on stderr: a live line with a progress bar on a terminal, plain lines otherwise."""

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
        """Print the metrics; on a terminal, only validation metrics remain as lines."""
        numbers = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        if self._live is None:
            print(f"step {step:>6}  {numbers}", file=sys.stderr, flush=True)
        elif "loss" in values:
            self._live.update(self._task, completed=step, description=numbers)
        else:
            self._live.print(f"step {step:>6}  {numbers}")

    def close(self) -> None:
        """End the live line."""
        if self._live is not None:
            self._live.stop()


class JsonLines:
    """A file of one JSON object per line; a resumed run first drops the steps that it repeats.

    A run from step 0 also repeats step 0, so it drops all lines.
    """

    def __init__(self, path: Path, *, resume_after: int = 0):
        self.path = path
        kept = []
        for number, line in read_lines(path) if path.exists() else ():
            if not isinstance(line, dict) or type(line.get("step")) is not int:
                raise InputError(f"{path}, line {number} has no step. Restore or remove it.")
            if line["step"] <= resume_after and resume_after > 0:
                kept.append(json.dumps(line))
        write_text(path, "".join(f"{line}\n" for line in kept))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Append a line of metrics to the file; a number that is not finite is null."""
        numbers = {name: value if isfinite(value) else None for name, value in values.items()}
        append_line(self.path, {"step": step, **numbers})

    def close(self) -> None:
        """Do nothing: every line is already on disk."""


class TensorBoard:
    """Scalars for TensorBoard, by tensorboardX; a resumed run purges the steps that it repeats."""

    def __init__(self, folder: Path, *, resume_after: int = 0):
        purge_step = resume_after + 1 if resume_after else 0
        self._writer = _package("tensorboard").SummaryWriter(str(folder), purge_step=purge_step)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Add a scalar for each metric."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Flush the event file."""
        self._writer.close()


class WandB:
    """A run of Weights & Biases; a resumed run continues it by the id in the run folder.

    W&B's environment variables configure server and login.
    """

    def __init__(self, folder: Path, *, project: str, name: str):
        wandb = _package("wandb")
        path, settings = folder / "wandb_id.txt", folder / "config.json"
        if not path.exists():
            write_text(path, secrets.token_hex(4))
        self._run = wandb.init(
            project=project,
            name=name,
            id=path.read_text("utf-8"),
            resume="allow",
            dir=str(folder),
            config=read_json(settings) if settings.exists() else None,
        )

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Log the metrics of a step."""
        self._run.log(dict(values), step=step)

    def close(self) -> None:
        """Finish the upload to Weights & Biases."""
        self._run.finish()


EXTRAS = {"tensorboard": "tensorboardX", "wandb": "wandb"}
"""Package of each optional writer by the name of its extra."""


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
