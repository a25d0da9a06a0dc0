"""Classical perception of ground-truth frames: moved objects, last poses, revealed surfaces."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from egosim_jax.geometry import invert, transform
from egosim_jax.perception.classical import ClassicalConfig, HandMasks
from egosim_jax.perception.oracle import OracleConfig
from egosim_jax.perception.video.silhouettes import hand_silhouette
from egosim_jax.rendering.reference import render
from egosim_jax.state.fuse import fuse
from egosim_jax.state.new_objects import is_among, without_ids
from egosim_jax.types import Clip, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, observation_of, to_action
from egosim_jax.worlds.tabletop.scene import FIRST_HAND

SPEC = VideoSpec(frames=17, height=96, width=160, fps=8)
SEEDS = (0, 1)


@pytest.fixture(scope="module", params=SEEDS)
def clip(request):
    return next(make_sequence(request.param, spec=SPEC))


def perceive(clip, *, frames=None, action=None, state=None):
    """Perceive a clip, or other frames of it, by its action or another one, in its state."""
    shown = Clip(frames=clip.frames if frames is None else frames, fps=8)
    return ClassicalConfig().build()(shown, action or to_action(clip), state or clip.state)


@pytest.fixture(scope="module")
def found(clip):
    return perceive(clip)


def seen_before(clip):
    """Return the pixels that see a point of the state; a seam around them may be set again."""
    known = np.isfinite(render(clip.state, clip.cameras, point_px=1).depth_m).astype(np.uint8)
    return np.stack([cv2.erode(frame, np.ones((5, 5), np.uint8)) for frame in known]) > 0


def test_the_object_that_was_carried_is_found(clip, found):
    assert set(found.world_from_object) == {clip.body_ids[clip.target]}


def test_its_points_end_within_a_centimeter_of_where_it_is(clip, found):
    target = clip.body_ids[clip.target]
    points = clip.state.points_m[clip.state.object_ids == target].astype(float)
    true = OracleConfig().build({0: observation_of(clip)})(
        Clip(frames=clip.frames, fps=8), to_action(clip), clip.state
    )
    here = transform(found.world_from_object[target][-1], points)
    there = transform(true.world_from_object[target][-1], points)
    gaps = np.linalg.norm(here[:, None] - there[None], axis=-1).min(axis=1)
    assert np.percentile(gaps, 95) < 0.01
    assert np.linalg.norm(there.mean(axis=0) - points.mean(axis=0)) > 0.1


@pytest.mark.parametrize("sigma_px", [2.0, 3.0])
def test_a_blurred_object_ends_where_the_hand_put_it(clip, sigma_px):
    blurred = np.stack([cv2.GaussianBlur(frame, (0, 0), sigma_px) for frame in clip.frames])
    found = perceive(clip, frames=blurred).world_from_object[clip.body_ids[clip.target]]
    true = clip.world_from_body[clip.target]
    gap = (found[-1] @ invert(found[0]) - true[-1] @ invert(true[0])) @ true[0][:, 3]
    assert np.linalg.norm(gap) < 0.01


@pytest.fixture(scope="module")
def found_without_ids(clip):
    bare = without_ids(clip.state)
    return bare, perceive(clip, state=bare)


def test_an_object_without_an_id_is_found_and_moved(clip, found_without_ids):
    bare, found = found_without_ids
    target = clip.state.points_m[clip.state.object_ids == clip.body_ids[clip.target]]
    assert found.names == {1: "object 1"}
    assert found.notes == ("hand 0 moved something without an id: it is object 1 now",)
    (points,) = found.new_objects.values()
    assert is_among(target, points).mean() > 0.95
    assert is_among(points, target).mean() > 0.95
    after = fuse(bare, found)
    path = clip.world_from_body[clip.target]
    there = transform(path[-1] @ invert(path[0]), target.astype(float))
    own = after.points_m[after.object_ids == 1]
    gaps = np.linalg.norm(own[:, None] - there[None], axis=-1).min(axis=1)
    assert np.percentile(gaps, 95) < 0.01
    assert is_among(target, after.points_m).mean() < 0.02


def test_in_the_next_clip_the_object_keeps_its_id(clip, found_without_ids):
    again = perceive(clip, state=fuse(*found_without_ids))
    assert again.new_objects == {}
    assert set(again.world_from_object) <= {1}


def test_the_table_under_a_moved_object_is_revealed(clip, found):
    bared = np.isfinite(found.depth_m[-1]) & (found.object_ids[-1] == 0)
    assert bared.any()
    truth = clip.depth_m[-1][bared]
    assert np.median(np.abs(found.depth_m[-1][bared] - truth)) < 0.005


def test_what_a_moved_object_uncovers_late_is_not_left_as_a_hole(clip, found):
    """The object's place is free for a few frames at the end of the clip."""
    first = replace(clip.cameras, world_from_camera=clip.cameras.world_from_camera[:1])
    place = clip.first.ids == clip.body_ids[clip.target]
    after = render(fuse(clip.state, found), first, point_px=1)
    assert np.isfinite(after.depth_m[0][place]).mean() > 0.8


def test_depth_that_agrees_with_the_state_stays_unknown(clip, found):
    assert np.isfinite(found.depth_m).mean() < 0.1


def test_the_silhouettes_cover_the_hands(clip):
    action = to_action(clip)
    covered = hand_silhouette(action.joints_m, action.kind, action.cameras, HandMasks()) >= 0
    hands = clip.ids >= FIRST_HAND
    assert (covered & hands).sum() / hands.sum() > 0.9
    assert covered.mean() < 3 * hands.mean()


def without_motion(clip):
    """Return frames of the state at rest, and the action, from a camera that does not move."""
    still = np.repeat(clip.first.colors[None], SPEC.frames, axis=0)
    poses = np.repeat(clip.cameras.world_from_camera[:1], SPEC.frames, axis=0)
    cameras = replace(clip.cameras, world_from_camera=poses)
    return {"frames": still, "action": replace(to_action(clip), cameras=cameras)}


def test_a_clip_without_motion_changes_nothing(clip):
    """The hand moves 15 cm above its path, where it holds nothing."""
    still = without_motion(clip)
    joints = still["action"].joints_m + np.float32([0, 0, 0.15])
    found = perceive(clip, **still | {"action": replace(still["action"], joints_m=joints)})
    assert not found.world_from_object
    after = fuse(clip.state, found)
    assert len(after.points_m) == len(clip.state.points_m)


def test_a_clip_that_leaves_an_object_at_rest_does_not_overrule_a_firm_grip(clip):
    found = perceive(clip, **without_motion(clip))
    target = clip.body_ids[clip.target]
    assert set(found.world_from_object) == {target}
    last, true = found.world_from_object[target][-1], clip.world_from_body[clip.target]
    gap = (last - true[-1] @ invert(true[0])) @ true[0][:, 3]
    assert np.linalg.norm(gap) < 0.02
    (note,) = found.notes
    assert f"carried {clip.target}, as predicted, but the clip shows it at rest" in note


def test_noise_of_a_video_does_not_hide_what_a_hand_carries(clip, found):
    assert found.notes == ()
    action, rng = to_action(clip), np.random.default_rng(0)
    noise = rng.normal(0, 0.004, action.joints_m.shape)
    shaken = replace(action, joints_m=(action.joints_m + noise).astype(action.joints_m.dtype))
    seen = perceive(clip, action=shaken)
    assert set(seen.world_from_object) == {clip.body_ids[clip.target]}


def test_without_hands_nothing_is_found(clip):
    action = to_action(clip)
    missing = replace(action, joints_m=np.full_like(action.joints_m, np.nan))
    found = perceive(clip, action=missing)
    assert not found.world_from_object
    assert not np.isfinite(found.depth_m[seen_before(clip)]).any()


def test_what_is_seen_for_the_first_time_is_where_it_is(clip, found):
    """The table and the floor, as the camera moves; and not the objects, whose sides are hidden."""
    new = np.isfinite(found.depth_m) & ~seen_before(clip) & (found.object_ids == 0)
    assert new.mean() > 0.01
    gaps = np.abs(found.depth_m - clip.depth_m)[new] / clip.depth_m[new]
    assert np.median(gaps) < 0.005
    assert (gaps > 0.02).mean() < 0.1


def test_only_one_of_two_hands_on_an_object_moves_it(clip, found):
    """A second hand around the same object, with the same motion."""
    action = to_action(clip)
    second = action.joints_m + [0.004, 0, 0]
    both = replace(action, joints_m=np.concatenate([second, action.joints_m], axis=1))
    twice = perceive(clip, action=both)
    assert twice.world_from_object.keys() == found.world_from_object.keys()
    target = clip.body_ids[clip.target]
    points = clip.state.points_m[clip.state.object_ids == target].astype(float).mean(axis=0)
    ends = [transform(path[target][-1], points[None]) for path in
            (found.world_from_object, twice.world_from_object)]  # fmt: skip
    assert np.linalg.norm(ends[0] - ends[1]) < 0.02


@pytest.mark.parametrize(
    ("kind", "seed", "number", "verb", "shape"),
    [
        ("human", 250, 2, "open", "chest"),
        ("human", 242, 2, "close", "chest"),
        ("robot", 244, 0, "open", "chest"),
        ("robot", 245, 1, "open", "cabinet"),
    ],
)
def test_furniture_is_found_open_or_shut(kind, seed, number, verb, shape):
    *_, clip = make_sequence(seed, spec=SPEC, kind=kind, clips=number + 1)
    target = clip.body_ids[clip.target]
    assert clip.verb == verb
    assert clip.state.names[target].endswith(shape)
    found = perceive(clip).world_from_object
    path = clip.world_from_body[clip.target]
    points = clip.state.points_m[clip.state.object_ids == target].astype(float)
    there = transform(path[-1] @ invert(path[0]), points)
    assert set(found) == {target}
    here = transform(found[target][-1] @ invert(found[target][0]), points)
    assert np.linalg.norm(here - there, axis=1).mean() < 0.02
    assert np.linalg.norm(there - points, axis=1).mean() > 0.07


@pytest.mark.parametrize(("aside_m", "moved"), [(0.0, True), (0.06, False)])
def test_in_uniform_frames_the_grip_decides(clip, aside_m, moved):
    gray = np.full_like(clip.frames, 127)
    action = to_action(clip)
    action = replace(action, joints_m=action.joints_m + np.array([0, 0, aside_m]), prompt="")
    found = perceive(clip, frames=gray, action=action)
    assert set(found.world_from_object) == ({clip.body_ids[clip.target]} if moved else set())
