"""The interface of a training's task, the roles of a distillation, and a recipe's stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
from flax import nnx
from jaxtyping import Array, Key

from egosim_jax.train.config import CriticConfig, TrainConfig

Batch = Mapping[str, jax.Array]
Metrics = dict[str, jax.Array]


@runtime_checkable
class Task(Protocol):
    """Networks to train, their examples and their loss."""

    @property
    def trained(self) -> Any:
        """The nnx filter of the trained weights; all others are frozen."""
        ...

    @property
    def frozen_dtype(self) -> str:
        """The dtype of the frozen weights."""
        ...

    def networks(self, rngs: nnx.Rngs) -> nnx.Module:
        """Return the networks with random weights."""
        ...

    def examples(self) -> Any:
        """Return the Grain transform from a record to an example, a dict of arrays, or None."""
        ...

    def shapes(self, batch: int) -> Mapping[str, jax.ShapeDtypeStruct]:
        """Return the shapes of a batch of examples, for compilation without data."""
        ...

    def keys(self, key: Key[Array, ""], batch: int) -> Key[Array, " *keys"]:
        """Return the random keys of each sample."""
        ...

    def loss(
        self, networks: Any, batch: Batch, keys: Key[Array, " *keys"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the mean loss of a batch, and further metrics to log."""
        ...

    def validate(self, networks: Any, batch: Batch) -> Metrics:
        """Return deterministic metrics of each sample; they depend only on it and its `record`."""
        ...

    def flops(self, samples: int) -> float:
        """Return the model FLOPs of an update on `samples` samples; NaN if unknown."""
        ...


class Roles(NamedTuple):
    """Networks of a distillation. They share the weights that are not trained."""

    student: Any
    """Networks that are trained."""
    average: Any
    """Networks with the moving average of the student's weights; the student without one."""
    teacher: Any
    """Networks that do not change."""
    critic: Any
    """Networks that learn what the student makes; None without a critic."""


@runtime_checkable
class Distillation(Task, Protocol):
    """Task of a student that learns from a teacher; its `loss` takes `Roles` for the networks."""

    critic: CriticConfig | None
    """Training of the critic; None: no critic."""


@runtime_checkable
class Criticized(Distillation, Protocol):
    """Distillation that can have a critic."""

    def critic_loss(
        self, roles: Roles, batch: Batch, keys: Key[Array, " *keys"]
    ) -> tuple[jax.Array, Metrics]:
        """Return the critic's mean loss of a batch, and further metrics to log."""
        ...


class Stage(NamedTuple):
    """One training of a recipe: its task and its hyper-parameters."""

    task: Task
    """Networks, examples and loss."""
    training: TrainConfig
    """Its hyper-parameters."""
