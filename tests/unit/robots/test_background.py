"""Frames without hands, and robots drawn into them."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mink")

from egosim_jax.geometry import pixel_rays
from egosim_jax.robots.background import first_cloud, moved, remove_hands
from egosim_jax.robots.drawing import SHADOW, draw
from egosim_jax.state.depth import state_from_depth
from egosim_jax.types import Cameras, GroundTruth
from egosim_jax.worlds.tabletop.embree import make_mesh

HEIGHT, WIDTH, FRAMES = 24, 32, 3
GRAY, RED, SKIN = (120, 120, 120), (200, 40, 40), (216, 150, 118)
SLEEVE_COLOR = (40, 60, 110)
BOX = np.s_[8:14, 4:10]
"""Pixels of the object in the first frame; it moves by 8 pixels."""
SHIFT_PX = 8


@pytest.fixture(scope="module")
def cameras():
    """A camera that looks down at a table 1 m away."""
    intrinsics = np.array([[40.0, 0, (WIDTH - 1) / 2], [0, 40.0, (HEIGHT - 1) / 2], [0, 0, 1]])
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = np.diag([1.0, -1.0, -1.0])
    poses[:, 2, 3] = 1
    return Cameras(world_from_camera=poses, intrinsics_px=intrinsics, height=HEIGHT, width=WIDTH)


def scene(cameras):
    """Return frames of a table and an object that moves, and the state before."""
    frames = np.full((FRAMES, HEIGHT, WIDTH, 3), GRAY, np.uint8)
    ids = np.zeros((FRAMES, HEIGHT, WIDTH), np.int32)
    motion = np.tile(np.eye(4), (FRAMES, 1, 1))
    for frame, shift in enumerate((0, SHIFT_PX // 2, SHIFT_PX)):
        rows, columns = BOX
        place = np.s_[frame, rows, columns.start + shift : columns.stop + shift]
        frames[place], ids[place] = RED, 1
        motion[frame, 0, 3] = shift / 40
    depth = np.ones((FRAMES, HEIGHT, WIDTH), np.float32)
    state = state_from_depth(
        frames[0], depth[0], cameras.intrinsics_px, cameras.world_from_camera[0],
        object_ids=ids[0],
    )  # fmt: skip
    return state, GroundTruth(frames=frames, depth_m=depth, object_ids=ids, motions={1: motion})


def test_a_hand_is_replaced_by_the_state_with_its_objects_moved(cameras):
    state, clean = scene(cameras)
    frames, ids, depth = clean.frames.copy(), clean.object_ids.copy(), clean.depth_m.copy()
    hand = np.s_[1:, 6:20, 10:22]
    frames[hand], ids[hand], depth[hand] = SKIN, -1, 0.7
    given = GroundTruth(frames=frames, depth_m=depth, object_ids=ids, motions=clean.motions)
    found = remove_hands(state, cameras, given)
    taken = found.from_state + found.from_first_frame + found.from_frames
    assert taken + found.unknown == found.hidden.sum()
    assert found.hidden[1:, 6:20, 10:22].all()
    known = np.ones_like(found.hidden)
    known[:, 7:15] = False  # the object's edge may be off by a pixel
    np.testing.assert_array_equal(found.frames[known], clean.frames[known])
    assert (found.frames[2, 9:13, 13:17] == RED).all()
    assert not (found.frames == SKIN).all(axis=-1).any()
    np.testing.assert_allclose(found.depth_m[np.isfinite(found.depth_m)], 1, atol=1e-5)


def test_what_the_state_does_not_show_is_taken_from_the_first_frame(cameras):
    state, clean = scene(cameras)
    seen = state.points_m[:, 0] < 0.2  # the state ends there
    part = {name: getattr(state, name)[seen] for name in ("points_m", "colors", "object_ids")}
    short = replace(state, **part, last_seen=state.last_seen[seen])
    frames, ids = clean.frames.copy(), clean.object_ids.copy()
    hand = np.s_[:, 2:6, 26:30]
    frames[hand], ids[hand] = SKIN, -1
    unknown = np.full_like(clean.depth_m, np.inf)
    given = GroundTruth(frames=frames, depth_m=unknown, object_ids=ids, motions=clean.motions)
    first = first_cloud(clean.frames[0], short, cameras)
    found = remove_hands(short, cameras, given, first=first)
    assert found.from_first_frame == found.hidden.sum()
    assert (found.frames[hand] == GRAY).all()
    known = np.isfinite(found.depth_m) & (found.depth_m < 2)  # the state's depth
    np.testing.assert_allclose(found.depth_m[known], 1, atol=1e-5)
    assert known[0, :, :20].all()


def test_a_sleeve_next_to_an_estimated_hand_is_removed(cameras):
    state, clean = scene(cameras)
    frames, ids = clean.frames.copy(), clean.object_ids.copy()
    frames[:, 15:22, 18:22], ids[:, 15:22, 18:22] = SKIN, -1
    frames[:, 15:22, 22:25] = SLEEVE_COLOR
    frames[:, 2:4, 26:29] = SLEEVE_COLOR  # not at the hand
    unknown = np.full_like(clean.depth_m, np.inf)
    given = GroundTruth(frames=frames, depth_m=unknown, object_ids=ids, motions=clean.motions)
    found = remove_hands(state, cameras, given, estimated=True)
    assert (found.frames[:, 15:22, 18:25] == GRAY).all()
    assert (found.frames[:, 2:4, 26:29] == SLEEVE_COLOR).all()
    assert found.hidden[:, 15:22, 22:25].all()


def test_the_shadow_of_a_hand_is_removed_and_that_of_others_stays(cameras):
    state, clean = scene(cameras)
    frames, ids, depth = clean.frames.copy(), clean.object_ids.copy(), clean.depth_m.copy()
    ids[:, 18:22, 24:28], depth[:, 18:22, 24:28] = -1, 0.7
    frames[:, 18:22, 20:23] = 60  # next to the hand
    frames[:, 2:4, 2:6] = 60
    given = GroundTruth(frames=frames, depth_m=depth, object_ids=ids, motions=clean.motions)
    found = remove_hands(state, cameras, given)
    assert (found.frames[:, 19:21, 21] == GRAY).all()
    assert (found.frames[:, 2:4, 2:6] == 60).all()
    assert found.shadow > 0


def test_objects_are_where_the_clip_left_them(cameras):
    state, clean = scene(cameras)
    after = moved(state, clean.motions)
    own = state.object_ids == 1
    shift = (after.points_m - state.points_m)[:, 0]
    np.testing.assert_allclose(shift[own], SHIFT_PX / 40, atol=1e-6)
    assert (shift[~own] == 0).all()


@pytest.mark.parametrize(("height_m", "seen"), [(0.3, True), (-0.3, False)])
def test_a_robot_hides_only_what_is_behind_it(cameras, height_m, seen):
    _, clean = scene(cameras)
    vertices, triangles = make_mesh("sphere", 0.1, 12)
    ball = (vertices + [0, 0, height_m], triangles)
    drawn = draw(
        clean.frames[:1], clean.depth_m[:1], cameras, [[ball]], [np.array([0.0, 0, 1])],
        world_from_up=np.eye(4),
    )  # fmt: skip
    assert drawn.mask[0, HEIGHT // 2, WIDTH // 2] == seen
    inside = _disc(cameras, 0.1, height_m) if seen else np.zeros((HEIGHT, WIDTH), bool)
    assert (drawn.mask[0] != inside).mean() < 0.02
    if seen:
        assert drawn.frames[0, HEIGHT // 2, WIDTH // 2, 2] > 100
        assert drawn.depth_m[0, HEIGHT // 2, WIDTH // 2] == pytest.approx(0.6, abs=0.01)


def test_a_robot_near_the_table_darkens_it(cameras):
    _, clean = scene(cameras)
    vertices, triangles = make_mesh("sphere", 0.1, 12)
    plain = np.full_like(clean.frames[:1], 200)
    drawn = draw(
        plain, clean.depth_m[:1], cameras, [[(vertices + [0, 0, 0.1], triangles)]],
        [np.ones(3)], world_from_up=np.eye(4),
    )  # fmt: skip
    outside = drawn.frames[0][~drawn.mask[0]]
    assert outside.min() < 200 * (SHADOW + 1) / 2
    assert (drawn.frames[0, 0] == 200).all()


def _disc(cameras, radius_m, height_m):
    rays = pixel_rays(cameras.intrinsics_px, height=HEIGHT, width=WIDTH)
    distance = 1 - height_m
    across = np.linalg.norm(rays[..., :2], axis=-1) / np.linalg.norm(rays, axis=-1)
    return across < radius_m / distance
