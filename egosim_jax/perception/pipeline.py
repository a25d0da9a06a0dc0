"""Perception as a pipeline of stages over one growing record.

A stage gets the clip, the action, the state before the clip, and the observation so far. It returns
the observation with its own fields added, so each stage sees all earlier results: segmentation
feeds tracking, tracking feeds depth. After the last stage the observation becomes a `Perceived`,
which updates the state.

A stage sees the generator's inputs and outputs, never the ground truth. The exception is `oracle`,
for tests and upper bounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, no_type_check, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from egosim_jax.state.filter import interacted_frames
from egosim_jax.state.new_objects import with_objects
from egosim_jax.types import Action, Cameras, Clip, InputError, Perceived, SceneState


@runtime_checkable
class Perception(Protocol):
    """Reconstruction of a clip in 3D: any callable, for example a `Pipeline`."""

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Perceived:
        """Return cameras, depth, objects and motions of the clip, in world coordinates."""
        ...


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Observation:
    """Results of a pipeline's stages for one clip; None where no stage has run yet."""

    cameras: Cameras | None = None
    """Camera of every frame, in the world."""
    joints_m: Float[np.ndarray, "f n j 3"] | None = None
    """World positions of the hand joints in meters; NaN where a hand is missing."""
    object_ids: Int32[np.ndarray, "f h w"] | None = None
    """Object id of each pixel: 0 is background, negative a hand or arm, else the state's id."""
    depth_m: Float32[np.ndarray, "f h w"] | None = None
    """Depth along the camera's z axis in meters; infinite where unknown."""
    motions: Mapping[int, Float[np.ndarray, "f 4 4"]] | None = None
    """Rigid motion in the world of each tracked object, relative to its pose before the clip."""
    support_planes: Mapping[int, Float[np.ndarray, " 4"]] | None = None
    """Plane a x + b y + c z + d = 0 below each tracked object; d is NaN if there is no plane."""
    interacted_frames: Mapping[int, Bool[np.ndarray, " f"]] | None = None
    """Frames in which hands acted on each object; only objects with at least one."""
    names: Mapping[int, str] | None = None
    """Object names by id; names that the state has may be omitted."""
    new_objects: Mapping[int, Float32[np.ndarray, "n 3"]] = field(default_factory=dict)
    """Points of the state that are an object without an id, by its new id."""
    held: Mapping[int, int] = field(default_factory=dict)
    """Object that each hand holds in the last frame, by the hand's index in the action."""
    notes: tuple[str, ...] = ()
    """New objects, and what could not be decided, in words for reports."""

    def require(self, field: str, needed_by: str) -> Any:
        """Return a field. Raises `InputError` with both names if no stage has set it."""
        value = getattr(self, field)
        if value is None:
            raise InputError(
                f"{needed_by} needs {field}, which no stage before it has set: add a stage to the "
                f"pipeline that sets {field}."
            )
        return value

    def finish(self, clip: Clip, state: SceneState) -> Perceived:
        """Return the finished observation as a `Perceived`.

        Raises `InputError` naming the first required field that no stage has set.
        """
        fields = ("cameras", "depth_m", "object_ids", "names", "motions", "interacted_frames")
        values = {field: self.require(field, "Perceived") for field in fields}
        depth_m, motions = values["depth_m"], values.pop("motions")
        return Perceived(
            step=state.step + 1,
            frames=clip.frames,
            new_objects=self.new_objects,
            held=self.held,
            notes=self.notes,
            world_from_object={
                number: motion @ state.world_from_object.get(number, np.eye(4))
                for number, motion in motions.items()
            },
            **{
                **values,
                "depth_m": np.where(np.isnan(depth_m), np.inf, depth_m).astype(np.float32),
                "object_ids": values["object_ids"].astype(np.int32),
            },
        )


@runtime_checkable
class Stage(Protocol):
    """One step of a perception pipeline: a function, or a frozen dataclass of its parameters."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Return the observation so far with this stage's fields added."""
        ...


@dataclass(frozen=True, kw_only=True)
class Pipeline:
    """A perception that runs stages in order over one observation."""

    stages: tuple[Stage, ...]

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Perceived:
        """Run the stages and return their result in world coordinates.

        After a stage that finds new objects, the state that later stages get has them.
        Raises `InputError` if a stage's depth or ids do not have one value per pixel, and if a
        stage or `Perceived` needs a field that no stage has set.
        """
        so_far = Observation()
        for stage in self.stages:
            so_far = stage(clip, action, state, so_far)
            _check_shapes(so_far, clip, stage)
            state = with_objects(state, so_far.new_objects)
        return so_far.finish(clip, state)


def find_interactions(
    clip: Clip, action: Action, state: SceneState, so_far: Observation
) -> Observation:
    """Set `interacted_frames` from object ids, depth and names; a stage that fits any pipeline."""
    ids, depth, names = (
        so_far.require(field, "find_interactions") for field in ("object_ids", "depth_m", "names")
    )
    interactions = interacted_frames(ids, depth, {**state.names, **names})
    return replace(so_far, interacted_frames=interactions)


def _check_shapes(so_far: Observation, clip: Clip, stage: Stage) -> None:
    shape = clip.frames.shape[:3]
    for name in ("depth_m", "object_ids"):
        value = getattr(so_far, name)
        if value is not None and value.shape != shape:
            culprit = getattr(stage, "__name__", type(stage).__name__)
            raise InputError(
                f"Perception stage {culprit} returned {name} of shape {value.shape} for a clip of "
                f"shape {shape}: it must have one value per pixel of each frame."
            )
