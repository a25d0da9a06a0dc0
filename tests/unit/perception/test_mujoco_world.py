"""Perception of a scene in MuJoCo, which shares nothing with the tabletop world, and its judge."""

import numpy as np
import pytest

from egosim_jax.perception import registry
from egosim_jax.types import Perceived
from tests.mujoco_world.judge import judge
from tests.mujoco_world.world import Film, make_film

CAPSULE = 3
"""Seed of the shortest film."""


@pytest.fixture(scope="module")
def film() -> Film:
    return make_film(CAPSULE)


def perceive(film: Film, motions: dict[int, np.ndarray]) -> Perceived:
    """Return a reconstruction with these motions and no depth."""
    frames = film.clip.frames
    return Perceived(
        step=1,
        frames=frames,
        cameras=film.action.cameras,
        depth_m=np.full(frames.shape[:3], np.inf, np.float32),
        object_ids=np.zeros(frames.shape[:3], np.int32),
        names={},
        world_from_object=motions,
        interacted_frames={},
    )


def test_gripper_puts_the_object_on_its_goal(film):
    layout, path = film.layout, film.motions[film.target_id]
    moved = np.linalg.norm(path[:, :3, 3] - path[0, :3, 3], axis=1)
    shift = np.linalg.norm(layout.goal_m - layout.placed[0].place_m)
    assert np.abs(np.trace(path[-1, :3, :3]) - 3) < 1e-3
    assert abs(moved[-1] - shift) < 2e-3
    assert moved.max() > moved[-1]  # it was lifted
    for number in film.motions.keys() - {film.target_id}:
        assert np.abs(film.motions[number] - np.eye(4)).max() < 1e-3
    assert set(np.unique(film.ids)) == {0, *film.motions}


def test_judge_accepts_the_truth_alone(film):
    truth = judge(film, lambda *_: perceive(film, film.motions), "true")
    assert (truth.moved, truth.left, truth.still, truth.dragged) == (1, 0, 1, 0)
    nothing = judge(film, lambda *_: perceive(film, {}), "true")
    assert (nothing.moved, nothing.left, nothing.still) == (0, 1, 1)
    swapped = {2: film.motions[film.target_id]}
    assert judge(film, lambda *_: perceive(film, swapped), "true").still < 0.7


def test_object_without_an_id_is_where_the_gripper_put_it(film):
    verdict = judge(film, registry.parse("classical").build(), "none")
    assert verdict.passed, verdict.notes
    assert verdict.dragged < 0.05
