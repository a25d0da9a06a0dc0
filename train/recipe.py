"""The interface of a recipe: a training that one command runs, or compiles for a preflight."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egosim_jax.io.executables import share_with_jax
from egosim_jax.sharding import check_batch, make_mesh
from egosim_jax.train.task import Stage
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class Recipe(ABC):
    """A training that one command runs, in one or several stages."""

    out: Path | None = None
    """Folder of the run."""
    preflight: str | None = None
    """Machine to compile for instead of training, such as h200:8, v5p:2x2x2 or cpu:1.

    The machine can be absent. Reports whether each stage's update fits; needs no other option."""
    json: bool = False
    """With --preflight: print JSON."""
    search: bool = True
    """With --preflight: also compile other settings for the same batch size; takes minutes."""

    def run(self) -> int:
        """Train, or run the preflight, and return the exit code."""
        if self.preflight is None:
            for option, is_given in {"--json": self.json, "--no-search": not self.search}.items():
                if is_given:
                    raise InputError(
                        f"{option} has no effect without --preflight: add it, or omit {option}."
                    )
            self._check_stages()
            share_with_jax()
            return self.train()
        from egosim_jax.preflight.targets import compile_offline
        from egosim_jax.train.preflight import preflight

        compile_offline()
        return preflight(self.stages(), self.preflight, as_json=self.json, search=self.search)

    def _check_stages(self) -> None:
        """Raise `InputError` for a stage that lacks a package or does not fit the devices."""
        for name, (_, training) in self.stages().items():
            training.check_packages()
            mesh, parts = make_mesh(training.mesh), training.grad_accum_steps
            check_batch(training.batch_size, mesh, parts, stage=name)

    def require(self, *names: str) -> list[Any]:
        """Return options that only training needs. Raises `InputError` if one is not given."""
        if missing := [name for name in names if getattr(self, name) is None]:
            options = ", ".join(f"--{name}" for name in missing)
            raise InputError(f"Missing {options}: required to train. Only --preflight needs none.")
        return [getattr(self, name) for name in names]

    @abstractmethod
    def train(self) -> int:
        """Train to the end, resuming an interrupted run, and return the exit code."""

    @abstractmethod
    def stages(self) -> Mapping[str, Stage]:
        """Return the trainings by the names of the fields that configure them."""
