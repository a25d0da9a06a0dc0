"""Choice between the parts of a cluster that may have moved."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import look_at
from egosim_jax.perception.objects.extent import choose_extent
from egosim_jax.perception.objects.film import ColorCost, Film, ObjectModel, ObjectMotion
from egosim_jax.rendering.reference import render
from tests.scenes import pinhole, state_of

FRAMES = 6
CAMERA = look_at(np.array([0, -0.5, 0.5]), np.zeros(3), up=np.array([0, 0, 1.0]))
CAMERAS = pinhole([CAMERA] * FRAMES, 80.0, 48, 80)
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


@pytest.mark.parametrize("part", ["drawer", "box and drawer"])
def test_the_part_that_a_clip_shows_in_motion_is_chosen(part):
    """A drawer's tray is in no state, and a moved box would reveal the table behind it."""
    top = np.stack(np.meshgrid(SIDE[38:63], SIDE[50:70], SIDE[[62]]), axis=-1).reshape(-1, 3)
    front = np.stack(np.meshgrid(SIDE[38:63], SIDE[[49]], SIDE[50:62]), axis=-1).reshape(-1, 3)
    points, count = np.concatenate([top, front]), len(top)
    paint = np.repeat(
        np.array([[230, 230, 220], [170, 140, 100]], np.float32), [count, len(front)], 0
    )
    plane = np.array([0, 0, 1.0, 0])
    whole = ObjectModel(number=0, points_m=points, colors=paint, plane=plane)
    drawer = ObjectModel(number=0, points_m=front, colors=paint[count:], plane=plane)
    most = ObjectModel(number=0, points_m=points[40:], colors=paint[40:], plane=plane)
    wood = np.full((len(TABLE), 3), (90, 100, 110), np.uint8)
    scene = state_of(np.concatenate([TABLE, points]), colors=np.concatenate([wood, paint]))
    moves = moved_to(0, -0.06, 0)
    candidates = [(-10.0, replace(moves, model=model)) for model in (whole, drawer, most)]
    frames = []
    for pose in moves.path:
        shift = pose[:3, 3]
        tray = np.stack(
            np.meshgrid(SIDE[38:63], np.arange(0, -shift[1], 0.004), SIDE[[52]]), axis=-1
        ).reshape(-1, 3) + np.array([0, shift[1] + SIDE[49], 0])
        rest = points + shift if part != "drawer" else np.concatenate([top, front + shift])
        extra = tray if part == "drawer" else tray[:0]
        inside = np.full((len(extra), 3), (200, 175, 130), np.uint8)
        film = state_of(
            np.concatenate([TABLE, rest, extra]), colors=np.concatenate([scene.colors, inside])
        )
        one = replace(CAMERAS, world_from_camera=CAMERAS.world_from_camera[:1])
        frames.append(render(film, one, point_px=2).frames[0])
    shown = np.stack(frames).astype(np.float32)
    hidden = np.zeros(shown.shape[:3], bool)
    film = Film(cameras=CAMERAS, shown=shown, hidden=hidden, color=ColorCost())
    chosen = choose_extent(candidates, [whole, drawer], film, scene)
    assert chosen == (1 if part == "drawer" else 0)
