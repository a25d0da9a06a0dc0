"""Agreement of predicted motion, state and true world in a trial: where not to trust a verdict.

In the true world, the state is the ground truth, and `prediction_cm` the error of the prediction.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float

from egosim_jax.dynamics import predict
from egosim_jax.geometry import invert, transform
from egosim_jax.interactive.env.tasks import Goal, objects_of
from egosim_jax.interactive.server.session import Session
from egosim_jax.simulation.actions import all_joints_of
from egosim_jax.types import Action, SceneState
from egosim_jax.types.arrays import Pose
from egosim_jax.worlds.tabletop import World, start_of_sequence

MEASURES = {
    "prediction_cm": ("prediction - state, cm", "{:.1f}"),
    "truth_cm": ("state - true world, cm", "{:.1f}"),
    "clip": ("clip = state, %", "{:.0f}"),
}
DEFINITIONS = {
    "true_success": "success of the same actions in the true tabletop world, which the policy did "
    "not see",
    "prediction_cm": "distance between the end of the predicted motion of an object and its place "
    "in the state after the clip, which perception read from the frames; mean over clips and "
    "objects that either moves",
    "truth_cm": "distance between the place of an object in the state and in the true tabletop "
    "world after the same actions; mean over clips and objects that either has moved",
    "clip": "smallest share of the pixels of a clip that agree with the state, of the background "
    "and of the untouched object that agrees least",
}
MOVED_M = 0.005
"""Motion from which an object counts as moved, in meters."""


def agreement(session: Session, goal: Goal, seed: int | None) -> dict[str, Any]:
    """Return the distances of a session's clips, and success in the true world.

    `seed` is of a tabletop scene whose clips a model makes; None: the state is the ground truth, or
    there is no other world to compare with.
    """
    starts = list(session.runs())
    if not starts:
        return {}
    start, numbers = starts[0]
    states = [start.state, *(session.load_result(number).state for number in numbers)]
    actions = [session.action(number) for number in numbers]
    figures: dict[str, Any] = {
        "prediction_cm": _mean_cm(_predicted(states, actions, session.backend.video.fps)),
        "clip": _clip_percent(session, numbers),
    }
    if seed is not None:
        true = list(_true_states(start.state, actions, seed, session))
        figures["truth_cm"] = _mean_cm(_distances_m(states[0], states[1:], true))
        figures["true_success"] = _succeeds(goal, states[0], true)
    return {name: value for name, value in figures.items() if value is not None}


def _succeeds(goal: Goal, first: SceneState, states: list[SceneState]) -> bool | None:
    """Return success in some states, as a trial has it; None if it does not follow from them."""
    if goal.judge_of is not None:
        return None
    if goal.waits:
        return all(goal.judge(first, state).success for state in states)
    for state in states:
        reward = goal.judge(first, state)
        if reward.terminated:
            return reward.success
    return False


def _mean_cm(distances_m: Iterator[float]) -> float | None:
    values = list(distances_m)
    return 100 * float(np.mean(values)) if values else None


def _clip_percent(session: Session, numbers: list[int]) -> float | None:
    """Return the smallest share of agreeing pixels of any clip, in percent."""
    infos = [session.load_result(number).info for number in numbers]
    names = "validity", "object_validity"
    shares = [info[name] for info in infos for name in names if info.get(name) is not None]
    return 100 * float(min(shares)) if shares else None


def _predicted(states: list[SceneState], actions: list[Action], fps: int) -> Iterator[float]:
    """Yield the distance in meters of each object that the prediction or the state moves."""
    for before, after, action in zip(states, states[1:], actions, strict=False):
        paths = predict(before, action, fps=fps).paths
        for number in objects_of(before):
            predicted = paths[number].motion[-1] if number in paths else np.eye(4)
            yield from _apart_m(_center(before, number), predicted, _motion(before, after, number))


def _distances_m(
    first: SceneState, states: list[SceneState], true: list[SceneState]
) -> Iterator[float]:
    """Yield the distance in meters of each object that a state or the true world has moved."""
    for state, truth in zip(states, true, strict=True):
        for number in objects_of(first):
            motions = (_motion(first, after, number) for after in (state, truth))
            yield from _apart_m(_center(first, number), *motions)


def _apart_m(center: Float[np.ndarray, "1 3"], *motions: Pose) -> Iterator[float]:
    """Yield the distance in meters between the places to which two motions bring an object.

    Nothing if neither moves it.
    """
    places = [transform(motion[None], center)[0] for motion in motions]
    if max(np.linalg.norm(place - center) for place in places) > MOVED_M:
        yield float(np.linalg.norm(places[0] - places[1]))


def _true_states(
    first: SceneState, actions: list[Action], seed: int, session: Session
) -> Iterator[SceneState]:
    """Yield the first state with its objects where the true world has them after each action."""
    kind = session.actions.kind
    scene = start_of_sequence(seed, spec=session.backend.video, kind=kind)[0]
    world, poses = World(scene=scene, seed=seed), _poses(scene)
    for action in actions:
        _, world = world.move(action, joints_m=all_joints_of(action))
        now = _poses(world.scene)
        yield moved(first, {number: now[number] @ invert(poses[number]) for number in poses})


def _poses(scene: Any) -> dict[int, Pose]:
    return {scene.instance_id(b.name): scene.first_part_pose(b.name) for b in scene.bodies}


def moved(first: SceneState, motions: Mapping[int, Pose]) -> SceneState:
    """Return a state whose objects moved, by id."""
    points, poses = first.points_m.copy(), dict(first.world_from_object)
    for number, motion in motions.items():
        chosen = first.object_ids == number
        points[chosen] = transform(motion[None], points[chosen].astype(float))
        poses[number] = motion @ poses.get(number, np.eye(4))
    return replace(first, points_m=points, world_from_object=poses, held={})


@no_type_check
def _center(state: SceneState, number: int) -> Float[np.ndarray, "1 3"]:
    return state.points_m[state.object_ids == number].astype(float).mean(axis=0)[None]


def _motion(before: SceneState, after: SceneState, number: int) -> Pose:
    """Return the motion of an object between two states."""
    earlier, later = (
        np.asarray(state.world_from_object.get(number, np.eye(4)), float)
        for state in (before, after)
    )
    return later @ invert(earlier)
