"""Perception pipelines by name: each one a frozen dataclass that configures and builds it.

Every field of a config is an option on the command line (`parse`), and its content is hashed into
the run it is used in, so that a run is not resumed with other parameters. A config of your own:

    @register("mine")
    @dataclass(frozen=True, kw_only=True)
    class MyConfig:
        threshold: float = 0.5

        def build(self, ground_truth=None) -> Pipeline:
            return Pipeline(stages=(take_action, MyDepth(self.threshold), ...))
"""

from __future__ import annotations

import difflib
import importlib
import shlex
from collections.abc import Callable, Mapping
from typing import Protocol, TypeVar, runtime_checkable

from egosim_jax.perception.pipeline import Observation, Perception
from egosim_jax.types import InputError

C = TypeVar("C", bound=type)
_MODULES = {
    "classical": "egosim_jax.perception.classical",
    "networks": "egosim_jax.perception.networks.closed_loop",
    "oracle": "egosim_jax.perception.oracle",
    "recorded": "egosim_jax.perception.recorded",
}
"""Modules that register the pipelines of this package, imported when first asked for."""
_CONFIGS: dict[str, type] = {}


@runtime_checkable
class PipelineConfig(Protocol):
    """Parameters of a perception pipeline: a frozen dataclass."""

    def build(self, ground_truth: Mapping[int, Observation] | None = None) -> Perception:
        """Return the perception pipeline; `ground_truth` has one observation per step of the state.

        Only `oracle` reads the ground truth.
        """
        ...


def register(name: str) -> Callable[[C], C]:
    """Register a perception config class under a name, as a decorator; later ones replace it."""

    def add(config: C) -> C:
        _CONFIGS[name] = config
        return config

    return add


def names() -> tuple[str, ...]:
    """Return the names of all registered perception pipelines, sorted."""
    return tuple(sorted({*_MODULES, *_CONFIGS}))


def get(name: str) -> type[PipelineConfig]:
    """Return the config class of the perception pipeline with a name.

    `my_package.module:mine` imports the module first, for a pipeline that it registers as `mine`.
    Raises `InputError` naming the closest name if there is none.
    """
    module, _, name = name.rpartition(":")
    if module.startswith("."):
        raise InputError(
            f"Perception pipeline {name[:80]!r}: module {module[:80]!r} is relative; give its full "
            "name. (--perception)"
        )
    if module := module or ("" if name in _CONFIGS else _MODULES.get(name, "")):
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise InputError(
                f"Perception pipeline {name[:80]!r}: module {error.name} cannot be imported. "
                "(--perception)"
            ) from error
    if name not in _CONFIGS:
        close = difflib.get_close_matches(name, names(), n=1, cutoff=0) or names()
        raise InputError(
            f"There is no perception pipeline {name[:80]!r}. Did you mean {close[0]!r}? Known: "
            f"{', '.join(names())}. (--perception)"
        )
    return _CONFIGS[name]


def parse(text: str) -> PipelineConfig:
    """Return the perception config that a command line specifies: a name and options.

    `classical` has the defaults; `classical --motion.reach-m 0.05` changes one; `NAME --help` lists
    all.
    """
    import tyro

    try:
        name, *options = shlex.split(text) or [""]
    except ValueError as error:
        raise InputError(
            f"Perception pipeline {text[:80]!r} is not a name with options: {error}. (--perception)"
        ) from error
    return tyro.cli(get(name), prog=f"--perception {name}", args=options)
