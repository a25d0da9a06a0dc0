"""The tabletop world: renderings agree with the ground-truth geometry."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import invert, pixel_rays, project, rotation_z, transform
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import (
    Object,
    hand_motion,
    make_scene,
    make_sequence,
    state_after,
    to_triplet,
)
from egosim_jax.worlds.tabletop.bodies import box, make_loose, split_edges
from egosim_jax.worlds.tabletop.hands import closure_for, joints_of, pinch
from egosim_jax.worlds.tabletop.raycast import Placed, RayCaster
from egosim_jax.worlds.tabletop.scene import FIRST_BODY, TABLE, Scene, sample_scene

SPEC = VideoSpec(frames=5, height=48, width=80)
INTRINSICS = np.array([[60.0, 0, 39.5], [0, 60.0, 23.5], [0, 0, 1]])


@pytest.fixture(scope="module")
def clips():
    return list(make_sequence(3, spec=SPEC, clips=2))


def points_of(clip, frame):
    """Unproject the depth of a frame to world points."""
    cameras = clip.cameras
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    local = rays * clip.depth_m[frame][..., None]
    return transform(cameras.world_from_camera[frame], local.reshape(-1, 3)).reshape(local.shape)


def caster_of(body, place_m=(0, 0, 0), turn=0.0):
    """Return the ray caster of a body, and the body's pose."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_z(turn), place_m
    placed = Placed(part=body.parts[0], world_from_part=pose, instance_id=FIRST_BODY)
    return RayCaster([placed]), pose


def level_camera(place_m):
    """Return the pose of a camera that looks along y."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[:3, 3] = place_m
    return pose


def test_the_table_is_planar(clips):
    for clip in clips:
        for frame in range(SPEC.frames):
            points = points_of(clip, frame)[clip.ids[frame] == TABLE]
            assert len(points) > 500
            assert np.abs(points[:, 2]).max() < 1e-4


def test_depth_and_ids_of_a_box_against_its_slabs():
    body = make_loose("box", "red", np.random.default_rng(0))
    caster, pose = caster_of(body, (0.02, 0.3, 0), turn=0.7)
    camera = level_camera((0, -0.1, 0.05))
    frame = caster.render(camera, INTRINSICS, height=48, width=80)
    rays = pixel_rays(INTRINSICS, height=48, width=80).reshape(-1, 3)
    body_from_camera = invert(pose) @ camera
    start = body_from_camera[:3, 3]
    way = rays @ body_from_camera[:3, :3].T
    x, y, z = body.size_m
    with np.errstate(divide="ignore"):
        a = (np.array([-x / 2, -y / 2, 0]) - start) / way
        b = (np.array([x / 2, y / 2, z]) - start) / way
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    hit = (enter <= leave) & (enter > 0)
    assert hit.sum() > 50
    assert ((frame.ids.ravel() == FIRST_BODY) != hit).mean() < 1e-3
    both = hit & np.isfinite(frame.depth_m.ravel())
    np.testing.assert_allclose(frame.depth_m.ravel()[both], enter[both], rtol=1e-5)


def test_a_ball_is_seen_where_its_pose_projects():
    body = make_loose("ball", "red", np.random.default_rng(0))
    caster, pose = caster_of(body, (0.02, 0.3, 0))
    camera = level_camera((0.02, -0.1, body.size_m[2] / 2))
    intrinsics = np.array([[160.0, 0, 79.5], [0, 160.0, 47.5], [0, 0, 1]])
    frame = caster.render(camera, intrinsics, height=96, width=160)
    rows, columns = np.nonzero(frame.ids == FIRST_BODY)
    center = pose @ [0, 0, body.size_m[2] / 2, 1]
    u, v = project(intrinsics, transform(invert(camera), center[None, :3]))
    assert abs(columns.mean() - u[0]) < 0.5
    assert abs(rows.mean() - v[0]) < 0.5


def test_visible_fingertips_are_seen_where_their_keypoints_project(clips):
    found = 0
    for clip in clips:
        for frame in range(SPEC.frames):
            camera = invert(clip.cameras.world_from_camera[frame])
            for hand, joints in enumerate(clip.joints_m[frame]):
                local = transform(camera, joints)
                u, v = project(clip.cameras.intrinsics_px, local)
                for column, row, z in zip(np.round(u), np.round(v), local[:, 2], strict=True):
                    if not (0 <= column < SPEC.width and 0 <= row < SPEC.height):
                        continue
                    here = int(row), int(column)
                    if clip.ids[frame][here] == 100 + 2 * hand:
                        gap = z - clip.depth_m[frame][here]
                        assert -0.03 < gap < 0.2
                        found += 0 <= gap < 0.03
    assert found > 30


def test_the_last_frame_of_a_clip_is_the_first_of_the_next(clips):
    first, second = clips
    assert (first.frames[-1] == second.frames[0]).all()
    assert (first.ids[-1] == second.ids[0]).all()
    assert (first.joints_m[-1] == second.joints_m[0]).all()
    for name, poses in first.world_from_body.items():
        assert (poses[-1] == second.world_from_body[name][0]).all()


def test_equal_seeds_give_equal_clips(clips):
    again = next(make_sequence(3, spec=SPEC))
    assert (again.frames == clips[0].frames).all()
    assert again.caption == clips[0].caption
    assert (next(make_sequence(4, spec=SPEC)).frames != clips[0].frames).any()


def test_a_bare_clip_differs_only_where_hands_or_target_are_or_throw_shadows(clips):
    bare = next(make_sequence(3, spec=SPEC, bare=True))
    target = clips[0].body_ids[clips[0].target]
    assert not np.isin(bare.ids, [target, 100, 101, 102, 103]).any()
    moving = (clips[0].ids == target) | (clips[0].ids >= 100)
    np.testing.assert_array_equal(bare.ids[~moving], clips[0].ids[~moving])
    np.testing.assert_array_equal(bare.depth_m[~moving], clips[0].depth_m[~moving])
    darker = bare.frames[~moving].astype(int) - clips[0].frames[~moving]
    assert (darker.mean(axis=1) >= -1).mean() > 0.9


def test_black_cloths_change_the_table_alone(clips):
    with_cloths = list(make_sequence(3, spec=SPEC, clips=2, black_cloths=3))
    for plain, clip in zip(clips, with_cloths, strict=True):
        assert (clip.ids == plain.ids).mean() > 0.999  # a cloth hides the lowest half millimeter
        np.testing.assert_array_equal(clip.joints_m, plain.joints_m)
        assert clip.caption == plain.caption
        changed = (clip.frames != plain.frames).any(axis=-1) & (plain.ids == TABLE)
        assert clip.frames[changed].mean() < 12
        assert changed.mean() > 0.01
    again = next(make_sequence(3, spec=SPEC, black_cloths=0))
    np.testing.assert_array_equal(again.frames, clips[0].frames)


def test_a_negative_number_of_cloths_is_refused():
    with pytest.raises(InputError, match="--black-cloths"):
        next(make_sequence(3, spec=SPEC, black_cloths=-1))


def test_a_prior_does_not_distinguish_a_black_cloth_from_an_unobserved_place():
    spec = VideoSpec(frames=5, height=96, width=160)
    triplet = to_triplet(next(make_sequence(3, spec=spec, black_cloths=3)))
    black = triplet.prior[-1].max(axis=-1) < 4
    assert (black & (triplet.mask[-1] == 0)).mean() > 0.01
    assert (black & (triplet.mask[-1] == 255)).mean() > 0.01


def test_only_the_target_moves(clips):
    for clip in clips:
        for name, poses in clip.world_from_body.items():
            moved = np.abs(poses - poses[0]).max() > 1e-6
            assert moved == (name == clip.target)


def test_a_prior_shows_the_first_frame_where_it_is_observed():
    clip = next(make_sequence(3, spec=VideoSpec(frames=5, height=96, width=160)))
    triplet = to_triplet(clip)
    seen = triplet.mask[0] == 0
    assert seen.mean() > 0.95
    difference = triplet.prior[0][seen].astype(float) - clip.first.colors[seen]
    assert np.abs(difference).mean() < 5  # of 255: the points of half a pixel round to whole ones
    assert not triplet.prior[-1][triplet.mask[-1] == 255].any()


def test_a_carried_state_has_its_objects_at_their_final_poses(clips):
    first, second = clips
    state = state_after(first, first.state)
    start, end = first.world_from_body[first.target][[0, -1]]
    moved = state.object_ids == first.body_ids[first.target]
    np.testing.assert_array_equal(state.points_m[~moved], first.state.points_m[~moved])
    np.testing.assert_allclose(
        transform(np.linalg.inv(end), state.points_m[moved]),
        transform(np.linalg.inv(start), first.state.points_m[moved]),
        atol=1e-6,
    )
    triplet = to_triplet(second, state)
    np.testing.assert_array_equal(triplet.first_frame, triplet.prior[0])


def test_black_bodies_are_never_chosen():
    for seed in range(40):
        rng = np.random.default_rng(seed)
        scene = sample_scene(rng)
        assert not scene.body(hand_motion.choose(scene, rng).name).static


@pytest.mark.parametrize("kind", ["human", "robot"])
@pytest.mark.parametrize("width", [0.02, 0.05, 0.07])
def test_a_hand_closes_until_its_fingertips_have_the_requested_distance(kind, width):
    closure = closure_for(kind, width)
    assert pinch(joints_of(kind, closure, "right"))[1] == pytest.approx(width, abs=1e-4)


def test_a_left_hand_is_the_mirror_image_of_a_right_one():
    right, left = joints_of("human", 0.3, "right"), joints_of("human", 0.3, "left")
    np.testing.assert_allclose(right * [-1, 1, 1], left)


def test_a_camera_inside_an_object_is_refused():
    body = make_loose("box", "red", np.random.default_rng(0))
    caster, camera = caster_of(body)[0], np.eye(4)
    camera[2, 3] = body.size_m[2] / 2
    with pytest.raises(InputError, match="inside an object"):
        caster.render(camera, INTRINSICS, height=48, width=80)
    camera[0, 3] = 0.2
    assert (caster.render(camera, INTRINSICS, height=48, width=80).ids == 0).all()


def test_a_state_outside_the_view_is_refused(clips):
    state = clips[0].state
    behind = replace(state, points_m=state.points_m - np.array([0, 9, 0], np.float32))
    with pytest.raises(InputError, match="None of the"):
        to_triplet(replace(clips[0], state=behind))


def test_hands_and_objects_may_leave_the_view(clips):
    away = clips[0].joints_m.copy()
    away[2:] += [5.0, 0, 0]
    away[1] = np.nan
    hands = to_triplet(replace(clips[0], joints_m=away)).hands
    assert hands[0].any()
    assert not hands[1:].any()


@pytest.mark.parametrize("change", [np.nan, [[2], [2], [2], [1]], [[1], [1], [-1], [1]]])
def test_cameras_that_are_not_rigid_or_without_focal_length_are_refused(clips, change):
    cameras = clips[0].cameras
    poses = cameras.world_from_camera.copy()
    poses[1] = poses[1] * change
    with pytest.raises(InputError, match="frame 1 is not a rigid"):
        replace(cameras, world_from_camera=poses)
    with pytest.raises(InputError, match="invalid intrinsics or image size"):
        replace(cameras, intrinsics_px=np.diag([0.0, 60.0, 1.0]))


def act_on(verb, kind="human"):
    """Return the first scene and intent with a verb among the seeds, and the moments."""
    for seed in range(200):
        rng = np.random.default_rng(seed)
        scene = sample_scene(rng)
        intent = hand_motion.choose(scene, rng)
        if intent.verb == verb:
            hand = hand_motion.start_hand(scene, intent, kind, rng)
            return scene, intent, hand_motion.act(scene, (hand,), intent, kind, frames=33)
    raise AssertionError(f"no scene in which to {verb}")


@pytest.mark.parametrize("kind", ["human", "robot"])
@pytest.mark.parametrize("verb", ["carry", "lift", "turn", "stack", "open"])
def test_a_body_moves_smoothly_and_ends_at_its_goal(verb, kind):
    _, intent, moments = act_on(verb, kind)
    poses = np.stack([moment.scene.first_part_pose(intent.name) for moment in moments])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 0.06
    start, end = poses[0], poses[-1]
    if intent.goal_m is not None:
        np.testing.assert_allclose(end[:3, 3], intent.goal_m, atol=1e-6)
    elif verb == "lift":
        np.testing.assert_allclose(end, start, atol=1e-6)
        assert poses[:, 2, 3].max() > 0.07
    elif verb == "turn":
        angle = np.arctan2(*(start[:3, :3].T @ end[:3, :3])[[1, 0], 0])
        assert angle == pytest.approx(intent.turn)
    else:
        assert moments[-1].scene.openings[intent.name] == pytest.approx(1)


def test_a_body_under_another_is_neither_taken_nor_opened():
    chest = Object(shape="lidded box", color="green", place_m=(0.1, 0.3))
    scene = make_scene([chest, Object(shape="cup", color="blue", on="green chest")])
    chosen = [hand_motion.choose(scene, np.random.default_rng(k)).name for k in range(20)]
    assert set(chosen) == {"blue cup"}


def test_an_opened_body_can_be_closed():
    scene, intent, moments = act_on("open")
    opened = moments[-1].scene
    close = hand_motion.Intent(verb="close", name=intent.name)
    last = hand_motion.act(opened, moments[-1].hands, close, "human", frames=9)[-1]
    assert last.scene.openings[intent.name] == pytest.approx(0)
    assert scene.openings[intent.name] == 0


def test_bodies_do_not_intersect():
    for seed in range(20):
        scene: Scene = sample_scene(np.random.default_rng(seed))
        assert 3 <= len(scene.bodies) <= 6
        places = [body.world_from_body[:2, 3] for body in scene.bodies]
        widths = [body.size_m[0] / 2 for body in scene.bodies]
        for a in range(len(places)):
            for b in range(a):
                assert np.linalg.norm(places[a] - places[b]) > widths[a] + widths[b]


def test_sharp_edges_are_split_and_flat_ones_are_not():
    vertices, triangles = split_edges(*box((0, 0, 0), (1, 1, 1)))
    assert len(vertices) == 24
    assert len(triangles) == 12
