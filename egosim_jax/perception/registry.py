"""Perception pipelines by name. A frozen dataclass configures and builds each one.

Every field of a config is a command-line option (`parse`). A run hashes the config into its
fingerprint, so it does not resume with other parameters. To add your own config:

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
"""Modules that register the built-in pipelines. They are imported on first use."""
_CONFIGS: dict[str, type] = {}


@runtime_checkable
class PipelineConfig(Protocol):
    """Parameters of a perception pipeline: a frozen dataclass."""

    def build(self, ground_truth: Mapping[int, Observation] | None = None) -> Perception:
        """Return the perception pipeline; `ground_truth` has one observation per state step.

        Only `oracle` reads the ground truth.
        """
        ...


def reads_ground_truth(config: PipelineConfig) -> bool:
    """Return False if a config states that its `build` ignores the ground truth.

    Ground truth of a simulated world is slow to render.
    """
    return getattr(config, "reads_ground_truth", True)


def register(name: str) -> Callable[[C], C]:
    """Return a decorator that registers a config class under a name; the last one wins."""

    def add(config: C) -> C:
        _CONFIGS[name] = config
        return config

    return add


def names() -> tuple[str, ...]:
    """Return the names of all registered perception pipelines, sorted."""
    return tuple(sorted({*_MODULES, *_CONFIGS}))


def get(name: str) -> type[PipelineConfig]:
    """Return the config class of a named perception pipeline.

    `my_package.module:mine` imports the module, which registers `mine`. Raises `InputError` with
    the closest name if the name is unknown.
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
    """Return the perception config for a command line, such as `classical --motion.reach-m 0.05`.

    `NAME --help` lists the options of a pipeline.
    """
    import tyro

    try:
        name, *options = shlex.split(text) or [""]
    except ValueError as error:
        raise InputError(
            f"Perception pipeline {text[:80]!r} is not a name with options: {error}. (--perception)"
        ) from error
    return tyro.cli(get(name), prog=f"--perception {name}", args=options)
