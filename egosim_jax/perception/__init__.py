"""Perception reads a generated clip, or a recorded video, back into 3D.

Estimators and pipelines belong here; fusing their results into the state does not (`state`). No
module but those in `networks` imports jax or torch.

    Perception:   any callable that maps a clip to a `Perceived`
    Pipeline:     a perception made of stages
    Stage:        one step, which adds fields to the observation
    Observation:  the results of the stages so far

`registry` has the pipelines by name: `classical`, `networks`, `oracle`, `recorded`. `estimates` has
the Protocols of the estimators in `cameras`, `depth`, `hands` and `networks`.
"""

from egosim_jax.perception.pipeline import Observation, Perception, Pipeline, Stage

__all__ = ["Observation", "Perception", "Pipeline", "Stage"]
