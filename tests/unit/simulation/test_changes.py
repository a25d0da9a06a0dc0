"""Objects that moved from one state to the next."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egosim_jax.simulation.changes import moved_objects
from egosim_jax.types import SceneState
from tests.scenes import state_of
from tests.unit.perception.clip.test_object_motion import FRAMES, carry, film, gripper, make_state
from tests.unit.perception.clip.test_object_motion import track as observe

CENTER = np.array([0.3, 0.1, 0.5])


def scene() -> SceneState:
    """A table and two objects."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1, 1, (40, 3)), CENTER + rng.normal(0, 0.02, (60, 3))])
    return state_of(points, ids=np.repeat([0, 1, 2], [20, 20, 60]), names={1: "green cone"})


def moved(state: SceneState, number: int, pose: np.ndarray) -> SceneState:
    """Move an object of a state on by a pose of the world."""
    points = state.points_m.astype(np.float64)
    chosen = state.object_ids == number
    points[chosen] = points[chosen] @ pose[:3, :3].T + pose[:3, 3]
    poses = dict(state.world_from_object)
    poses[number] = pose @ poses.get(number, np.eye(4))
    return replace(state, points_m=points.astype(np.float32), world_from_object=poses)


def turn(degrees: float, about_m: np.ndarray, then_m: tuple[float, float, float]) -> np.ndarray:
    """Turn about a point, then move on."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0, 0, degrees], degrees=True).as_matrix()
    pose[:3, 3] = about_m - pose[:3, :3] @ about_m + then_m
    return pose


def test_nothing_is_said_of_objects_that_stay():
    start = moved(scene(), 2, turn(20, CENTER, (0.1, 0, 0)))
    assert moved_objects(scene(), scene()) == []
    assert moved_objects(start, replace(start, step=1)) == []


@pytest.mark.parametrize("before", [(), (70.0,)])
def test_the_motion_is_of_the_center_and_since_the_state_before(before):
    start = scene()
    for degrees in before:
        start = moved(start, 2, turn(degrees, CENTER, (0.2, 0, 0)))
    center = start.points_m[start.object_ids == 2].mean(axis=0, dtype=np.float64)
    end = moved(start, 2, turn(30, center, (0.03, 0.04, 0)))
    (found,) = moved_objects(start, replace(end, held={1: 2}))
    assert found.object_id == 2
    assert found.held
    np.testing.assert_allclose((found.moved_mm, found.turned_deg), (50, 30), rtol=1e-3)
    assert str(found) == "object 2: moved by 50 mm, turned by 30 degrees, and is held"


def test_objects_have_their_names_and_the_order_of_their_ids():
    end = moved(moved(scene(), 2, turn(0, CENTER, (0, 0, 0.01))), 1, turn(0, CENTER, (0.02, 0, 0)))
    first, second = moved_objects(scene(), end)
    assert str(first) == "green cone: moved by 20 mm, turned by 0 degrees, and is released"
    assert (second.object_id, second.name, second.held) == (2, "object 2", False)


@pytest.mark.parametrize("held", [True, False])
def test_what_a_hand_may_have_held_is_not_called_released(held):
    """Perception's own note says so, of the same object only."""
    state, path = make_state((0, 0)), carry((0, 0), (0, 0, 0.1))
    frames = film(state, {1: path - path[0]})
    path[:4, 2] += [0.12, 0.08, 0.04, 0]
    notes = observe(state, [gripper(path, np.full(FRAMES, 0.036))], frames).notes
    start = replace(scene(), names={1: "red cube 1", 2: "red cube 11"})
    end = replace(moved(start, 1, turn(0, CENTER, (0.061, 0, 0))), held={0: 1} if held else {})
    end = moved(end, 2, turn(0, CENTER, (0, 0, 0.01)))
    first, second = moved_objects(start, end, notes)
    assert str(first).endswith("and is held" if held else "and may still be held")
    assert str(second).endswith("and is released")
