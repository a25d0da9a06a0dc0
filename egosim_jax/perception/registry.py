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

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from egosim_jax.perception.pipeline import Observation, Perception
from egosim_jax.runtime.registry import Registry


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


PIPELINES: Registry[type[PipelineConfig]] = Registry(
    "perception pipeline",
    "--perception",
    "egosim_jax.perception",
    {
        "classical": "egosim_jax.perception.classical:classical",
        "networks": "egosim_jax.perception.networks.closed_loop:networks",
        "oracle": "egosim_jax.perception.oracle:oracle",
        "recorded": "egosim_jax.perception.recorded:recorded",
    },
)
"""Config classes of the perception pipelines."""
register = PIPELINES.register
"""Decorator that registers a config class under a name; the last one wins."""
names = PIPELINES.names
"""Function that returns the names of all pipelines, sorted."""
get = PIPELINES.get
"""Function that returns the config class of a name, `MODULE:NAME` or entry point."""
parse = PIPELINES.parse
"""Function that returns the config of a text such as `classical --motion.evidence 12`."""
