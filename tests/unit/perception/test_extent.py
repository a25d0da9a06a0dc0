"""Choice between the ends of a moved object."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import look_at
from egosim_jax.perception.extent import best_of, with_other_ends
from egosim_jax.perception.pose_refinement import ColorCost, ObjectModel, ObjectMotion
from egosim_jax.rendering.reference import render
from egosim_jax.types import Cameras, SceneState

FRAMES = 6
CAMERAS = Cameras(
    world_from_camera=np.repeat(
        look_at(np.array([0, -0.5, 0.5]), np.zeros(3), up=np.array([0, 0, 1.0]))[None], FRAMES, 0
    ),
    intrinsics_px=np.array([[80.0, 0, 39.5], [0, 80, 23.5], [0, 0, 1]]),
    height=48,
    width=80,
)
SIDE = np.arange(-0.2, 0.2, 0.004)
TABLE = np.stack(np.meshgrid(SIDE, SIDE, [0.0]), axis=-1).reshape(-1, 3)
CUBE = np.stack(np.meshgrid(SIDE[45:56], SIDE[45:56], SIDE[50:61]), axis=-1).reshape(-1, 3)
MODEL = ObjectModel(
    number=1,
    points_m=CUBE,
    colors=np.full((len(CUBE), 3), (200, 30, 30), np.float32),
    plane=np.array([0, 0, 1.0, 0]),
)


def moved_to(*end_m):
    """Return the motion of the cube to a place, in three frames."""
    path = np.repeat(np.eye(4)[None], FRAMES, axis=0)
    path[:, :3, 3] = np.clip(np.arange(FRAMES) / 3, 0, 1)[:, None] * np.array(end_m, float)
    return ObjectMotion(model=MODEL, grasped=0, released=3, path=path)


@pytest.fixture(scope="module")
def state() -> SceneState:
    """State of the cube on a table, without ids."""
    points = np.concatenate([TABLE, CUBE]).astype(np.float32)
    wood = np.full((len(TABLE), 3), (150, 140, 120), np.uint8)
    return SceneState(
        points_m=points,
        colors=np.concatenate([wood, MODEL.colors.astype(np.uint8)]),
        object_ids=np.zeros(len(points), np.int32),
        last_seen=np.zeros(len(points), np.int32),
        intrinsics_px=CAMERAS.intrinsics_px,
    )


def filmed(state, motion):
    """Return the frames that show a motion."""
    frames = []
    for frame, pose in enumerate(motion.path):
        points = np.concatenate([TABLE, CUBE + pose[:3, 3]]).astype(np.float32)
        camera = replace(CAMERAS, world_from_camera=CAMERAS.world_from_camera[frame : frame + 1])
        frames.append(render(replace(state, points_m=points), camera, point_px=2).frames[0])
    return np.array(frames, np.float32)


def test_ends_that_are_close_are_one():
    ranked = [(-9.0 + n, moved_to(x, 0, 0)) for n, x in enumerate([0.1, 0.105, 0.15, 0.1, 0.05])]
    kept = with_other_ends(ranked, 3)
    assert kept == [ranked[0], ranked[2], ranked[4]]
    assert with_other_ends(ranked, 2) == kept[:2]


def test_the_scene_decides_against_an_end_below_the_table(state):
    truth, below = moved_to(0.1, 0, 0), moved_to(0.05, 0.05, -0.06)
    ranked = [(-12.0, below), (-10.0, truth)]
    hidden = np.zeros((FRAMES, CAMERAS.height, CAMERAS.width), bool)
    scene = CAMERAS, state, filmed(state, truth), hidden, ColorCost()
    assert best_of([[], ranked], *scene) is ranked[1]
    assert best_of([ranked[:1], ranked[1:]], *scene) is ranked[0]  # of two objects
    assert best_of([[], []], *scene) is None


def test_the_points_decide_if_a_hand_hides_the_scene(state):
    ranked = [(-12.0, moved_to(0.1, 0, 0)), (-10.0, moved_to(0.05, 0, 0))]
    hidden = np.ones((FRAMES, CAMERAS.height, CAMERAS.width), bool)
    shown = np.zeros((*hidden.shape, 3), np.float32)
    assert best_of([ranked], CAMERAS, state, shown, hidden, ColorCost()) is ranked[0]
