"""Predictions against the tabletop world, which shares no code with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.dynamics import predict
from egosim_jax.geometry import invert, transform
from egosim_jax.types import Action, Kind, SceneState, VideoSpec
from egosim_jax.worlds.tabletop import make_scripts
from egosim_jax.worlds.tabletop.clips import first_view
from egosim_jax.worlds.tabletop.hand_motion import Grip
from egosim_jax.worlds.tabletop.policies import POLICIES
from egosim_jax.worlds.tabletop.scene import Scene
from egosim_jax.worlds.tabletop.sequence import Script
from egosim_jax.worlds.tabletop.world import World

SPEC = VideoSpec(frames=17, height=96, width=160, fps=8)


def script_of(verb: str, seed: int, kind: Kind = "human") -> Script:
    """Return the first variant of a seed's script with a verb."""
    scripts = (next(make_scripts(seed, spec=SPEC, kind=kind, variant=v)) for v in range(30))
    return next(script for script in scripts if script.intent.verb == verb)


def state_of(script: Script) -> SceneState:
    """Return the state of the script's first frame."""
    return replace(
        first_view(script.scene, script.cameras)[1], provenance={"world": "tabletop", "seed": "0"}
    )


def motions_of(scenes: list[Scene]) -> dict[int, np.ndarray]:
    """Return the true motion of each body since the first frame, by id."""
    first = scenes[0]
    paths = {
        first.instance_id(body.name): np.stack([s.first_part_pose(body.name) for s in scenes])
        for body in first.bodies
    }
    return {number: path @ invert(path[0]) for number, path in paths.items()}


def errors_m(state: SceneState, action: Action, true: dict[int, np.ndarray]) -> np.ndarray:
    """Return the mean distance of each object's points from its true place, for each frame."""
    motion, rest = predict(state, action), np.repeat(np.eye(4)[None], SPEC.frames, axis=0)
    errors = []
    for number in np.unique(state.object_ids[state.object_ids > 0]).tolist():
        points = state.points_m[state.object_ids == number].astype(float)
        predicted = motion.paths[number].motion if number in motion.paths else rest
        gaps = transform(true.get(number, rest), points) - transform(predicted, points)
        errors.append(np.linalg.norm(gaps, axis=-1).mean(axis=1))
    return np.stack(errors)


@pytest.mark.parametrize(
    ("verb", "seed", "kind"),
    [
        ("carry", 31, "human"),
        ("lift", 32, "robot"),
        ("stack", 33, "human"),
        ("turn", 34, "human"),
        ("open", 35, "robot"),
    ],
)
def test_a_grasped_object_follows_the_hand(verb, seed, kind):
    script = script_of(verb, seed, kind)
    true = motions_of([moment.scene for moment in script.moments])
    errors = errors_m(state_of(script), script.action, true)
    assert max(np.abs(path - np.eye(4)).max() for path in true.values()) > 0.03
    assert np.median(errors.max(axis=0)) < 0.005
    assert errors.max() < 0.015


def test_a_hand_that_never_closes_moves_nothing():
    script = script_of("carry", 31)
    policy = next(policy for policy in POLICIES if not policy.grasps)
    joints = policy.plan(script, np.random.default_rng(0))
    assert not predict(state_of(script), replace(script.action, joints_m=joints)).paths


def test_a_closed_gripper_pushes_what_is_in_its_way():
    script = script_of("carry", 36, "robot")
    body = script.scene.body(script.intent.name)
    middle = body.world_from_body[:3, 3] + [0, 0, body.size_m[2] / 2]
    joints = np.array(
        [
            [Grip(point_m=middle + [x, 0, 0], yaw=0.3, pitch=0.9, closure=1.0).pose("robot", s)[0]]
            for s in ("right",)
            for x in np.linspace(-0.1, 0.02, SPEC.frames)
        ]
    )
    action = replace(script.action, joints_m=joints)
    scenes, _ = World(scene=script.scene).move(action)
    number = scenes[0].instance_id(body.name)
    path = predict(state_of(script), action).paths[number]
    assert [cause.how for cause in path.causes] == ["pushed"]
    true = motions_of(scenes)[number]
    points = transform(body.world_from_body, body.parts[0].vertices_m)
    assert np.linalg.norm(transform(true[-1], points) - points, axis=1).mean() > 0.02
    gap = np.linalg.norm(transform(true[-1], points) - transform(path.motion[-1], points), axis=1)
    assert gap.mean() < 0.015


def test_noise_of_a_video_does_not_hide_a_carry():
    script = script_of("carry", 31)
    rng = np.random.default_rng(1)
    joints = script.joints_m + rng.normal(0, 0.003, script.joints_m.shape)
    joints[rng.random(SPEC.frames) < 0.1] = np.nan
    true = motions_of([moment.scene for moment in script.moments])
    number = script.scene.instance_id(script.intent.name)
    motion = predict(state_of(script), replace(script.action, joints_m=joints))
    far = np.linalg.norm(true[number][-1, :3, 3])
    assert np.linalg.norm((motion.paths[number].motion - true[number])[-1, :3, 3]) < 0.3 * far


def test_a_state_in_other_axes_has_the_same_motion():
    script = script_of("carry", 31)
    state, action = state_of(script), script.action
    expected = predict(state, action).paths
    turn = np.eye(4)
    turn[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    turn[:3, 3] = [0.3, -1, 2]
    other = replace(
        state,
        points_m=transform(turn, state.points_m.astype(float)).astype(np.float32),
        provenance={},
    )
    cameras = replace(
        action.cameras, world_from_camera=turn @ np.asarray(action.cameras.world_from_camera)
    )
    moved = replace(action, cameras=cameras, joints_m=transform(turn[None, None], action.joints_m))
    paths = predict(other, moved).paths
    assert paths.keys() == expected.keys()
    for number, path in paths.items():
        points = state.points_m[state.object_ids == number].astype(float)
        back = invert(turn) @ path.motion @ turn
        gaps = transform(back, points) - transform(expected[number].motion, points)
        assert np.linalg.norm(gaps, axis=-1).max() < 0.005
