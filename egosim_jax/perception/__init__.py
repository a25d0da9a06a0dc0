"""Perception: a clip read back into 3D by a pipeline of stages.

`registry` has the pipelines by name; `pipeline` says what a stage is.
"""

from egosim_jax.perception.pipeline import Observation, Perception, Pipeline, Stage

__all__ = ["Observation", "Perception", "Pipeline", "Stage"]
