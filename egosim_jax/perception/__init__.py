"""Perception reads a generated clip, or a recorded video, back into 3D.

Estimators and pipelines belong here; fusing their results into the state does not (`state`). No
module but those in `networks` imports jax or torch.

    Perception:   any callable that maps a clip to a `Perceived`
    Pipeline:     a perception made of stages
    Stage:        one step, which adds fields to the observation
    Observation:  the results of the stages so far

    clip/       judges the predicted motion by a clip in a known state; new surfaces
    objects/    finds objects without an id: growth, and how far they reach
    video/      a recorded video from nothing: cameras, depth, hands, scale, background
    networks/   networks in child processes

`registry` has the pipelines by name: `classical`, `networks`, `oracle`, `recorded`.
`video.estimates` has the Protocols of the estimators in `video` and `networks`.
"""

from egosim_jax.perception.pipeline import Observation, Perception, Pipeline, Stage

__all__ = ["Observation", "Perception", "Pipeline", "Stage"]
