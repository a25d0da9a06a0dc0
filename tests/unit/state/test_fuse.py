"""Fusion of a scene whose surfaces a formula gives: a plate on a table, moved and taken away."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from egosim_jax.geometry import pixel_rays
from egosim_jax.state.fuse import fuse
from egosim_jax.state.snapshot import fingerprint
from egosim_jax.state.tsdf import Fusion
from egosim_jax.types import Perceived
from tests.scenes import pinhole, state_of

HEIGHT, WIDTH, FRAMES = 60, 80, 6
TABLE_M, PLATE_M = 0.60, 0.55
COARSE = Fusion(voxel_m=0.005)


def cameras(x=0.0):
    """Straight down the z axis, `x` meters aside."""
    pose = np.eye(4)
    pose[0, 3] = x
    return pinhole([pose] * FRAMES, 100.0, HEIGHT, WIDTH)


def image(plates, x=0.0):
    """Depth and ids when the plate's lower left corner is at each of `plates`; None: no plate."""
    depth = np.full((FRAMES, HEIGHT, WIDTH), TABLE_M, np.float32)
    ids = np.zeros(depth.shape, np.int32)
    rays = pixel_rays(cameras().intrinsics_px, height=HEIGHT, width=WIDTH)
    for frame, corner in enumerate(plates):
        if corner is not None:
            places = rays[..., :2] * PLATE_M + [x, 0] - corner
            on = ((places >= 0) & (places <= 0.08)).all(axis=-1)
            depth[frame][on], ids[frame][on] = PLATE_M, 1
    return depth, ids


def perceived(plates, *, x=0.0, step=1, **changes):
    depth, ids = image(plates, x)
    colors = np.where(ids[..., None] == 1, [200, 30, 30], [120, 110, 90]).astype(np.uint8)
    whole = {
        "step": step,
        "frames": colors,
        "cameras": cameras(x),
        "depth_m": depth,
        "object_ids": ids,
        "names": {1: "plate"},
        "world_from_object": {},
        "interacted_frames": {},
    }
    return Perceived(**{**whole, **changes})


@cache
def start():
    """A state with a far away point alone, then what the first image shows."""
    seed = state_of([[50.0, 50, 50]])
    return fuse(seed, perceived([HERE] * FRAMES, step=0), fusion=COARSE)


HERE, THERE = np.array([-0.12, -0.04]), np.array([0.06, -0.04])


def path():
    """The plate slides over in the middle frames and rests at the end."""
    shares = np.array([0, 0, 0.5, 1, 1, 1])
    poses = np.repeat(np.eye(4)[None], FRAMES, axis=0)
    poses[:, :2, 3] = shares[:, None] * (THERE - HERE)
    return poses, [HERE + share * (THERE - HERE) for share in shares]


def at(state, corner, *, lower=0.0):
    """Count the points at the plate's height over a place."""
    places = state.points_m[:, :2] - corner
    on = ((places >= lower) & (places <= 0.08 - lower)).all(axis=1)
    return int((on & (np.abs(state.points_m[:, 2] - PLATE_M) < 0.01)).sum())


def tracked(step=1):
    poses, plates = path()
    return perceived(plates, step=step, world_from_object={1: poses})


@cache
def moved():
    return fuse(start(), tracked(), fusion=COARSE)


def test_a_tracked_object_is_at_its_new_place_alone():
    state = moved()
    assert at(start(), HERE) > 180
    assert at(state, HERE) == 0
    assert at(state, THERE) > 100
    own = state.points_m[state.object_ids == 1]
    assert (np.abs(own[:, 2] - PLATE_M) < 0.0025).mean() > 0.95
    assert (np.abs(own[:, :2] - THERE - 0.04).max(axis=1) < 0.046).all()


def test_the_table_under_a_moved_object_becomes_known():
    state = moved()

    def table_under_plate(state):
        places = state.points_m[:, :2] - HERE
        inside = ((places > 0.02) & (places < 0.06)).all(axis=1)
        return int((inside & (np.abs(state.points_m[:, 2] - TABLE_M) < 0.003)).sum())

    assert table_under_plate(start()) == 0
    assert table_under_plate(state) > 30


def test_fusing_the_same_again_changes_nothing():
    twice = fuse(moved(), tracked(), fusion=COARSE)
    assert fingerprint(twice) == fingerprint(moved())


def test_no_update_changes_a_color_when_it_is_repeated():
    """Noisy depth, so that frames see through points of the same clip, and drifting colors."""
    rng = np.random.default_rng(0)
    state = start()
    for step in range(1, 4):
        clip = tracked(step) if step == 1 else perceived([THERE] * FRAMES, step=step)
        noise = rng.normal(0, 0.012, clip.depth_m.shape).astype(np.float32)
        colors = rng.integers(0, 255, clip.frames.shape).astype(np.uint8)
        clip = replace(clip, depth_m=clip.depth_m + noise, frames=colors)
        state = fuse(state, clip, fusion=COARSE)
        again = fuse(state, clip, fusion=COARSE)
        np.testing.assert_array_equal(again.points_m, state.points_m)
        np.testing.assert_array_equal(again.colors, state.colors, err_msg=f"update {step}")


def test_what_was_seen_keeps_its_colors_and_what_is_new_has_those_of_the_clip():
    clip = tracked()
    drifted = replace(clip, frames=255 - clip.frames)
    state = fuse(start(), drifted, fusion=COARSE)
    plate, table = state.object_ids == 1, state.object_ids == 0
    np.testing.assert_array_equal(state.colors[plate], np.tile([200, 30, 30], (plate.sum(), 1)))
    # The table under the plate had not been seen before.
    places = state.points_m[:, :2] - HERE
    bared = table & ((places > 0.02) & (places < 0.06)).all(axis=1)
    np.testing.assert_array_equal(state.colors[bared], np.tile([135, 145, 165], (bared.sum(), 1)))
    assert bared.sum() > 30
    far = table & (state.points_m[:, 2] < 1) & ((places < -0.03) | (places > 0.11)).any(axis=1)
    painted = (state.colors[far] == [120, 110, 90]).all(axis=1)
    assert painted.mean() > 0.95


def test_an_object_comes_back_by_the_way_it_went():
    poses, plates = path()
    back = perceived(plates[::-1], step=2, world_from_object={1: poses[::-1]})
    state = fuse(moved(), back, fusion=COARSE)
    assert at(state, THERE) == 0
    assert at(state, HERE) > 100
    np.testing.assert_array_equal(state.world_from_object[1], np.eye(4))


def test_its_back_that_no_frame_shows_moves_with_it():
    before = start()
    back = np.array([[HERE[0] + 0.04, HERE[1] + 0.04, PLATE_M + 0.03]], np.float32)
    before = replace(
        before,
        points_m=np.concatenate([before.points_m, back]),
        colors=np.concatenate([before.colors, [[1, 2, 3]]]).astype(np.uint8),
        object_ids=np.append(before.object_ids, np.int32(1)),
        last_seen=np.append(before.last_seen, np.int32(0)),
    )
    state = fuse(before, tracked(), fusion=COARSE)
    (row,) = np.flatnonzero((state.colors == (1, 2, 3)).all(axis=1))
    expected = back[0] + [*(THERE - HERE), 0]
    np.testing.assert_allclose(state.points_m[row], expected, atol=1e-6)
    assert state.last_seen[row] == 0


def test_an_object_that_moved_untracked_leaves_no_ghost_points():
    """It was interacted with and not tracked: it is where it was seen last."""
    _, plates = path()
    interacted = np.array([False, True, True, True, False, False])
    state = fuse(start(), perceived(plates, interacted_frames={1: interacted}), fusion=COARSE)
    assert at(state, HERE, lower=0.015) == 0
    assert at(state, THERE) > 100
    own = state.points_m[state.object_ids == 1]
    assert (np.abs(own[:, :2] - THERE - 0.04).max(axis=1) < 0.046).all()


@pytest.mark.parametrize(("distance_m", "kept"), [(0.004, True), (0.006, False)])
def test_a_surface_within_5_mm_keeps_its_color(distance_m, kept):
    clip = perceived([HERE] * FRAMES)
    near = replace(clip, frames=255 - clip.frames, depth_m=clip.depth_m + np.float32(distance_m))
    state = fuse(start(), near, fusion=COARSE)
    new = state.points_m[:, 2] > TABLE_M + distance_m / 2
    new &= (np.abs(state.points_m[:, :2]) < 0.1).all(axis=1) & (state.points_m[:, 2] < 1)
    same = (state.colors[new] == [120, 110, 90]).all(axis=1)
    assert same.mean() > 0.95 if kept else not same.any()


def test_an_object_that_was_carried_away_has_disappeared():
    plates = [HERE, HERE, None, None, None, None]
    interacted = np.array([False, True, True, False, False, False])
    state = fuse(start(), perceived(plates, interacted_frames={1: interacted}), fusion=COARSE)
    assert at(state, HERE) == 0
    assert not (state.object_ids == 1).any()


def test_an_object_without_interaction_that_no_frame_sees_through_stays():
    plates = [HERE, HERE, HERE, None, None, None]
    hidden = perceived(plates)
    depth, ids = hidden.depth_m.copy(), hidden.object_ids.copy()
    depth[3:, :, :45], ids[3:, :, :45] = 0.3, -1  # an arm in front
    state = fuse(start(), replace(hidden, depth_m=depth, object_ids=ids), fusion=COARSE)
    assert at(state, HERE) > 100


def test_hands_never_enter_the_state():
    clip = tracked()
    depth, ids = clip.depth_m.copy(), clip.object_ids.copy()
    depth[:, 20:40, 60:70], ids[:, 20:40, 60:70] = 0.3, -2
    state = fuse(start(), replace(clip, depth_m=depth, object_ids=ids), fusion=COARSE)
    assert (state.points_m[:, 2] > 0.5).all()
    assert (state.object_ids >= 0).all()


def test_an_object_that_leaves_the_view_is_where_it_was_carried():
    shares, aside = np.array([0, 0.2, 0.5, 1, 1, 1]), np.array([0.9, 0])
    poses = np.repeat(np.eye(4)[None], FRAMES, axis=0)
    poses[:, :2, 3] = shares[:, None] * aside
    plates = [HERE + share * aside for share in shares]
    state = fuse(start(), perceived(plates, world_from_object={1: poses}), fusion=COARSE)
    assert at(state, HERE) == 0
    assert at(state, HERE + aside) > 100


@pytest.mark.parametrize("how", ["tracked", "interacted", "neither"])
def test_an_empty_mask_where_depth_sees_through_removes_the_object(how):
    """No pixel is the object's, and the table is seen where it was and where it should be now."""
    poses, _ = path()
    changes = {
        "tracked": {"world_from_object": {1: poses}},
        "interacted": {"interacted_frames": {1: np.arange(FRAMES) < 3}},
        "neither": {},
    }[how]
    state = fuse(start(), perceived([None] * FRAMES, **changes), fusion=COARSE)
    assert at(state, HERE) == at(state, THERE) == 0
    assert not (state.object_ids == 1).any()


def test_one_frame_that_sees_through_an_object_removes_it():
    depth = np.full((FRAMES, HEIGHT, WIDTH), np.inf, np.float32)
    depth[3] = TABLE_M
    state = fuse(start(), perceived([None] * FRAMES, depth_m=depth), fusion=COARSE)
    assert at(state, HERE) == 0


def test_an_empty_mask_without_depth_moves_what_is_remembered():
    poses, _ = path()
    unknown = np.full((FRAMES, HEIGHT, WIDTH), np.inf, np.float32)
    clip = perceived([None] * FRAMES, depth_m=unknown, world_from_object={1: poses})
    state = fuse(start(), clip, fusion=COARSE)
    assert at(state, HERE) == 0
    assert at(state, THERE) > 100


def test_a_clip_in_which_nothing_is_known_leaves_the_points():
    before = start()
    nothing = perceived([None] * FRAMES, depth_m=np.full((FRAMES, HEIGHT, WIDTH), np.inf, "f4"))
    state = fuse(before, nothing, fusion=COARSE)
    np.testing.assert_array_equal(state.points_m, before.points_m)
    assert (before.step, state.step) == (0, 1)


def test_nan_depth_is_unknown_depth():
    clip = tracked()
    depth = np.where(clip.object_ids == 1, clip.depth_m, np.nan).astype(np.float32)
    state = fuse(start(), replace(clip, depth_m=depth), fusion=COARSE)
    assert np.isfinite(state.points_m).all()
    assert at(state, THERE) > 100


def test_clips_that_see_different_places_may_come_in_either_order():
    elsewhere = perceived([None] * FRAMES, x=3.0, step=2)
    state = fuse(fuse(start(), elsewhere, fusion=COARSE), tracked(), fusion=COARSE)
    assert fingerprint(state) == fingerprint(fuse(moved(), elsewhere, fusion=COARSE))


@pytest.mark.slow
def test_a_hundred_steps_do_not_make_it_grow():
    """A wobbling look at a small piece of table, with noise in its depth."""
    rng = np.random.default_rng(0)
    state, sizes = start(), []
    for step in range(1, 101):
        pose = np.repeat(np.eye(4)[None], 2, axis=0)
        pose[:, :2, 3] = rng.uniform(-0.01, 0.01, 2)
        clip = Perceived(
            step=step,
            frames=np.zeros((2, 12, 16, 3), np.uint8),
            cameras=pinhole(pose, 100.0, 12, 16),
            depth_m=rng.normal(TABLE_M, 0.002, (2, 12, 16)).astype(np.float32),
            object_ids=np.zeros((2, 12, 16), np.int32),
            names={},
            world_from_object={},
            interacted_frames={},
        )
        state = fuse(state, clip, fusion=COARSE)
        sizes.append(len(state.points_m))
    assert max(sizes[20:]) <= 1.1 * max(sizes[:20])


def test_points_that_are_seen_again_say_so():
    state = moved()
    own = state.object_ids == 1
    assert own.any()
    assert (state.last_seen[own] == 1).all()
    assert state.last_seen[(state.points_m == 50).all(axis=1)] == 0
