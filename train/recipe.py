"""What all recipes have in common: they train, or say whether they would fit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

from egosim_jax.train.settings import Stage


@dataclass(frozen=True, kw_only=True)
class Recipe(ABC):
    """A training that one command runs."""

    preflight: str | None = None
    """Train nothing, but compile each stage's update for a machine that need not be there, as in
    h200:8, v5p:2x2x2 or cpu:1, and say whether it fits. Needs no other option."""
    json: bool = False
    """With --preflight: print JSON."""
    search: bool = True
    """With --preflight: also compile the other settings that take the same batch, which takes
    minutes."""

    def run(self) -> int:
        """Train, unless a preflight was asked for."""
        if self.preflight is None:
            for stage in self.stages().values():
                stage.training.check_packages()
            return self.train()
        from egosim_jax.train.preflight import preflight

        return preflight(self.stages(), self.preflight, as_json=self.json, search=self.search)

    @abstractmethod
    def train(self) -> int:
        """Train to the end, or go on."""

    @abstractmethod
    def stages(self) -> Mapping[str, Stage]:
        """What is trained, by the names of the recipe's options."""
