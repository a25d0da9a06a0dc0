"""The true world executes any action: contact, grasp, carry, release, push, drawer and lid."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from egosim_jax.types import Action, InputError, Kind, VideoSpec
from egosim_jax.worlds.tabletop import (
    Object,
    World,
    hand_motion,
    make_scene,
    make_sequence,
    to_action,
)
from egosim_jax.worlds.tabletop.hand_motion import Grip
from egosim_jax.worlds.tabletop.hands import (
    FLESH_M,
    closure_for,
    frame_of,
    joints_of,
    side_of,
    touching,
)
from egosim_jax.worlds.tabletop.pushes import push_out
from egosim_jax.worlds.tabletop.scene import sample_scene
from egosim_jax.worlds.tabletop.solids import surface_of

SPEC = VideoSpec(frames=5, height=32, width=48)
GRAB, OPENED = closure_for("robot", 0.072), closure_for("robot", 0.095)
CLOSED = 0.9


@pytest.fixture(scope="module")
def cameras():
    return next(make_sequence(3, spec=SPEC)).cameras


def drive(cameras, *keys, kind: Kind = "robot", frames=8, yaw=0.0):
    """Return the action of one hand through keys (x, y, z, closure) in meters, in straight lines.

    A longer key also has a yaw and a downward pitch of the fingers.
    """
    grips = [
        Grip(point_m=np.array(key[:3]), yaw=(key[4:5] or (yaw,))[0], closure=key[3],
             pitch=(key[5:] or (np.radians(52),))[0])
        for key in keys
    ]  # fmt: skip
    poses = [grip.pose(kind, "right")[0] for grip in grips]
    path = [
        a + share * (b - a)
        for a, b in pairwise(poses)
        for share in np.linspace(0, 1, frames, endpoint=False)
    ]
    return act(cameras, np.array([*path, poses[-1]])[:, None], kind)


def act(cameras, joints, kind: Kind = "robot"):
    poses = np.repeat(cameras.world_from_camera[:1], len(joints), axis=0)
    return Action(cameras=replace(cameras, world_from_camera=poses), joints_m=joints, kind=kind,
                  prompt="")  # fmt: skip


def world_of(*objects):
    return World(scene=make_scene([Object(**item) for item in objects]))


BOX = {"shape": "box", "color": "red", "place_m": (0.0, 0.25)}
PICK = [(0, 0.23, 0.12, OPENED), (0, 0.25, 0.045, OPENED), (0, 0.25, 0.045, GRAB)]


def place_of(world, name="red box"):
    return world.scene.body(name).world_from_body[:3, 3]


def test_a_body_is_picked_up_carried_and_put_down(cameras):
    keys = [*PICK, (0.1, 0.3, 0.14, GRAB), (0.15, 0.3, 0.045, GRAB), (0.15, 0.3, 0.045, OPENED)]
    scenes, world = world_of(BOX).move(drive(cameras, *keys))
    heights = [scene.body("red box").world_from_body[2, 3] for scene in scenes]
    assert max(heights) == pytest.approx(0.095, abs=0.005)
    np.testing.assert_allclose(place_of(world), [0.15, 0.3, 0], atol=2e-3)
    assert not world.grasps


def test_a_body_is_held_until_the_hand_opens_across_actions(cameras):
    action = drive(cameras, *PICK, (0.1, 0.3, 0.14, GRAB), (0.1, 0.3, 0.10, GRAB))
    _, whole = world_of(BOX).move(action)
    half = len(action.joints_m) // 2 + 3
    _, between = world_of(BOX).move(act(cameras, action.joints_m[: half + 1]))
    _, parts = between.move(act(cameras, action.joints_m[half:]))
    assert [grasp.name for grasp in whole.grasps] == ["red box"]
    np.testing.assert_allclose(place_of(parts), place_of(whole), atol=1e-9)
    assert parts.number == 2


def test_a_body_released_in_the_air_rests_on_what_is_below(cameras):
    below = {"shape": "box", "color": "blue", "place_m": (0.15, 0.3)}
    keys = [*PICK, (0.15, 0.3, 0.2, GRAB), (0.16, 0.3, 0.2, GRAB), (0.16, 0.3, 0.2, OPENED)]
    _, world = world_of(BOX, below).move(drive(cameras, *keys))
    np.testing.assert_allclose(place_of(world), [0.16, 0.3, 0.075], atol=3e-3)
    np.testing.assert_allclose(place_of(world, "blue box"), [0.15, 0.3, 0])


def test_a_body_released_over_an_edge_slides_off_to_the_table(cameras):
    below = {"shape": "box", "color": "blue", "place_m": (0.15, 0.3)}
    keys = [*PICK, (0.2, 0.3, 0.2, GRAB), (0.2, 0.3, 0.2, OPENED)]
    _, world = world_of(BOX, below).move(drive(cameras, *keys))
    x, _, z = place_of(world)
    assert z == pytest.approx(0)
    assert x >= 0.15 + 0.072 - 2e-3


def test_a_body_beyond_the_table_falls_to_the_floor(cameras):
    keys = [*PICK, (0.4, 0.3, 0.15, GRAB), (0.72, 0.3, 0.15, GRAB), (0.72, 0.3, 0.15, OPENED)]
    _, world = world_of(BOX).move(drive(cameras, *keys))
    assert place_of(world)[2] == pytest.approx(-0.74)


def test_a_tilted_body_falls_on_its_nearest_face(cameras):
    keys = [*PICK, (0, 0.25, 0.2, GRAB), (0, 0.25, 0.2, GRAB, 0.0, np.radians(52 + 70)),
            (0, 0.25, 0.2, OPENED, 0.0, np.radians(52 + 70))]  # fmt: skip
    _, world = world_of(BOX).move(drive(cameras, *keys))
    rotation = world.scene.body("red box").world_from_body[:3, :3]
    assert abs(rotation[2, 1]) == pytest.approx(1, abs=1e-6)  # it lies on a side
    vertices = world.scene.body("red box").parts[0].vertices_m @ rotation.T + place_of(world)
    assert vertices[:, 2].min() == pytest.approx(0, abs=1e-9)


def test_closing_next_to_a_body_grasps_nothing(cameras):
    off = [(x, y - 0.06, z, closure) for x, y, z, closure in PICK]
    _, world = world_of(BOX).move(drive(cameras, *off, (0, 0.19, 0.2, GRAB)))
    assert not world.grasps
    np.testing.assert_allclose(place_of(world), [0, 0.25, 0])


@pytest.mark.parametrize("kind", ["robot", "human"])
def test_a_closed_hand_pushes_a_body_as_far_as_it_goes(cameras, kind):
    keys = [(0.0, 0.12, 0.04, CLOSED), (0.0, 0.26, 0.04, CLOSED)]
    scenes, world = world_of(BOX).move(drive(cameras, *keys, kind=kind))
    ways = np.array([scene.body("red box").world_from_body[1, 3] for scene in scenes])
    assert (np.diff(ways) >= -1e-9).all()
    reach = drive(cameras, *keys, kind=kind).joints_m[-1, 0, :, 1].max()
    assert place_of(world)[1] - 0.036 == pytest.approx(reach, abs=0.01)
    assert place_of(world)[2] == 0


def test_a_push_off_center_turns_a_body(cameras):
    keys = [(0.025, 0.12, 0.04, CLOSED), (0.025, 0.26, 0.04, CLOSED)]
    _, world = world_of(BOX).move(drive(cameras, *keys))
    rotation = world.scene.body("red box").world_from_body[:3, :3]
    assert np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0])) > 5
    assert rotation[2, 2] == pytest.approx(1)


def test_a_pushed_body_pushes_others_but_not_furniture(cameras):
    behind = {"shape": "cylinder", "color": "blue", "place_m": (0.0, 0.34)}
    keys = [(0.0, 0.12, 0.04, CLOSED), (0.0, 0.26, 0.04, CLOSED)]
    _, world = world_of(BOX, behind).move(drive(cameras, *keys))
    gap = place_of(world, "blue cylinder")[1] - place_of(world)[1]
    assert gap == pytest.approx(0.072, abs=3e-3)
    cabinet = {"shape": "drawer", "color": "green", "place_m": (0.0, 0.36)}
    _, world = world_of(BOX, cabinet).move(drive(cameras, *keys))
    np.testing.assert_array_equal(place_of(world, "green cabinet"), [0, 0.36, 0])
    assert place_of(world)[1] + 0.036 < 0.30 + 3e-3


def depth_in_flesh(scenes, joints, kind, name="red box"):
    """Return how deep a body is in the flesh of the first hand, at every frame in meters."""
    return np.array(
        [
            FLESH_M[kind] - surface_of(scene, scene.body(name), touching(frame[0], kind))[0].min()
            for scene, frame in zip(scenes, joints, strict=True)
        ]
    )


@pytest.mark.parametrize("way", [-1, 1])
def test_an_open_hand_sweeps_a_body_out_of_its_way(cameras, way):
    # The fingertips, 45 mm beyond the pinch point, cross the box.
    keys = [(way * -0.15, 0.205, 0.035, 0.1), (way * 0.02, 0.205, 0.035, 0.1)]
    action = drive(cameras, *keys, kind="human", frames=16)
    scenes, world = world_of(BOX).move(action)
    assert way * place_of(world)[0] > 0.03
    assert depth_in_flesh(scenes, action.joints_m, "human").max() < 1e-3


@pytest.mark.parametrize("kind", ["robot", "human"])
def test_an_open_hand_that_reaches_around_a_body_moves_nothing(cameras, kind):
    closure = OPENED if kind == "robot" else 0.1
    keys = [(0, 0.17, 0.15, closure), (0, 0.25, 0.045, closure), (0, 0.17, 0.15, closure)]
    _, world = world_of(BOX).move(drive(cameras, *keys, kind=kind))
    np.testing.assert_array_equal(place_of(world), [0, 0.25, 0])


def test_a_jaw_pushes_with_its_middle(cameras):
    level = (CLOSED, 0.0, 0.0)  # horizontal: the tips are beyond the box, the palm before it
    keys = [(-0.1, 0.292, 0.04, *level), (0.03, 0.292, 0.04, *level)]
    _, world = world_of(BOX).move(drive(cameras, *keys))
    assert place_of(world)[0] > 0.06


def test_a_point_above_or_below_a_body_does_not_push_it():
    ball = {"shape": "ball", "color": "red", "place_m": (0.0, 0.25), "width_m": 0.07}
    scene = world_of(ball).scene
    for height in (0.075, 0.069, 0.001):
        after, presses = push_out(scene, "red ball", np.array([[1e-12, 0.25, height]]), 0.008)
        assert after is scene
        assert presses.all()
    # Next to each other, the first push may bring the ball below the second point.
    points = np.array([[0.03, 0.25, 0.03], [0.035, 0.25, 0.076]])
    after, _ = push_out(scene, "red ball", points, 0.008)
    assert np.linalg.norm(place_of(World(scene=after), "red ball") - [0, 0.25, 0]) < 0.05


def test_what_stands_on_a_body_is_carried_with_it(cameras):
    top = {"shape": "cup", "color": "blue", "on": "red box"}
    keys = [*PICK, (0.1, 0.3, 0.14, GRAB), (0.15, 0.3, 0.045, GRAB), (0.15, 0.3, 0.045, OPENED)]
    _, world = world_of(BOX, top).move(drive(cameras, *keys))
    np.testing.assert_allclose(place_of(world, "blue cup"), [0.15, 0.3, 0.075], atol=3e-3)


def test_a_drawer_opens_with_its_handle_and_stops(cameras):
    cabinet = {"shape": "drawer", "color": "green", "place_m": (0.0, 0.35)}
    x, y, z = 0, 0.35 - 0.06 - 0.016, 0.04
    grab = closure_for("robot", 0.016)
    keys = [(x, y - 0.05, z, OPENED), (x, y, z, OPENED), (x, y, z, grab), (x, y - 0.04, z, grab)]
    _, world = world_of(cabinet).move(drive(cameras, *keys))
    assert world.scene.openings["green cabinet"] == pytest.approx(0.04 / 0.075, abs=0.02)
    _, world = world.move(drive(cameras, keys[-1], (x, y - 0.2, z, grab)))
    assert world.scene.openings["green cabinet"] == pytest.approx(1)
    assert not world.grasps  # its fingers slipped off at the stop


def test_a_lid_falls_shut_unless_it_is_beyond_the_vertical(cameras):
    chest = {"shape": "lidded box", "color": "green", "place_m": (0.0, 0.3)}
    world = world_of(chest)
    body = world.scene.body("green chest")
    hands = []
    for opening in (0.0, 0.25, 0.5, 0.95):
        scene = world.scene.with_opening("green chest", opening)
        intent = hand_motion.Intent(verb="open", name="green chest")
        grip = hand_motion.grip_on(scene, intent, "robot", "right")
        hands.append((*grip.point_m, grip.closure, 0.0, grip.pitch))
    opened = (*hands[0][:3], OPENED, 0.0, hands[0][5])
    for last, expected in ((2, 0.0), (3, 1.0)):
        end = (*hands[last][:3], OPENED, 0.0, hands[last][5])
        scenes, after = world.move(drive(cameras, opened, *hands[: last + 1], end))
        peak = max(scene.openings[body.name] for scene in scenes)
        assert peak >= (0.45, 0.9)[last - 2]
        assert after.scene.openings[body.name] == pytest.approx(expected)


def test_a_body_put_into_an_open_chest_keeps_its_lid_open(cameras):
    chest = {"shape": "lidded box", "color": "green", "place_m": (0.0, 0.3), "opening": 1}
    ball = {"shape": "ball", "color": "red", "on": "green chest", "width_m": 0.066}
    world = world_of(chest, ball)
    assert place_of(world, "red ball")[2] == pytest.approx(0.007)
    push = [(0.0, 0.45, 0.13, CLOSED), (0.0, 0.2, 0.09, CLOSED)]
    _, after = world.move(drive(cameras, *push))
    assert 0 < after.scene.openings["green chest"] < 1


def test_a_body_is_handed_from_one_hand_to_the_other(cameras):
    first = drive(cameras, *PICK, (0, 0.25, 0.15, GRAB), (0, 0.25, 0.15, GRAB),
                  (0, 0.25, 0.15, OPENED), (0.1, 0.2, 0.2, OPENED)).joints_m  # fmt: skip
    turned = np.pi / 2
    second = drive(cameras, (0.2, 0.25, 0.17, OPENED), (0.2, 0.25, 0.17, OPENED),
                   (0, 0.25, 0.17, OPENED), (0, 0.25, 0.17, GRAB), (0, 0.25, 0.17, GRAB),
                   (0, 0.25, 0.17, GRAB), (0, 0.25, 0.2, GRAB), yaw=turned).joints_m  # fmt: skip
    _, world = world_of(BOX).move(act(cameras, np.concatenate([first, second], axis=1)))
    assert [(grasp.hand, grasp.name) for grasp in world.grasps] == [(1, "red box")]
    assert place_of(world)[2] > 0.1


def test_a_hand_that_disappears_lets_go(cameras):
    action = drive(cameras, *PICK, (0, 0.25, 0.15, GRAB), (0, 0.25, 0.15, GRAB))
    joints = action.joints_m.copy()
    joints[-4:] = np.nan
    _, world = world_of(BOX).move(replace(action, joints_m=joints))
    assert not world.grasps
    np.testing.assert_allclose(place_of(world), [0, 0.25, 0], atol=3e-3)


def test_a_hand_that_holds_a_body_may_be_absent_from_the_next_action(cameras):
    held = drive(cameras, *PICK[1:], (0, 0.25, 0.15, GRAB), frames=4).joints_m
    away = drive(cameras, (0.2, 0.2, 0.2, OPENED), (0.2, 0.2, 0.2, OPENED)).joints_m
    first = away[:1].repeat(len(held), axis=0)
    _, world = world_of(BOX).move(act(cameras, np.concatenate([first, held], axis=1)))
    assert [grasp.hand for grasp in world.grasps] == [1]
    scenes, world = world.move(act(cameras, first))
    assert not world.grasps
    np.testing.assert_allclose(place_of(replace(world, scene=scenes[0]))[2], 0, atol=1e-6)


def test_a_hand_that_appears_inside_a_body_does_not_push_it(cameras):
    action = drive(cameras, (0.02, 0.25, 0.03, CLOSED), (0.021, 0.25, 0.03, CLOSED))
    joints = action.joints_m.copy()
    joints[:3] = np.nan
    start = world_of(BOX)
    _, world = start.move(replace(action, joints_m=joints))
    np.testing.assert_allclose(place_of(world), place_of(start), atol=1e-9)


@pytest.mark.parametrize("shape", [(3, 1, 3, 3), (9, 1, 21, 3), (9, 3, 3)])
def test_joints_of_another_shape_are_refused(cameras, shape):
    action = drive(cameras, *PICK[:2])
    with pytest.raises(InputError, match="as many frames as cameras"):
        world_of(BOX).move(action, joints_m=np.zeros(shape))


def test_an_executed_clip_has_its_ground_truth(cameras):
    start = world_of(BOX)
    action = to_action(next(make_sequence(3, spec=SPEC)))
    clip, after = start.execute(action)
    again, _ = start.execute(action)
    np.testing.assert_array_equal(clip.frames, again.frames)
    np.testing.assert_array_equal(clip.joints_m, action.joints_m)
    assert clip.frames.shape == (5, 32, 48, 3)
    assert clip.target == ""
    assert (clip.number, after.number) == (0, 1)
    first, state = start.observe(action.cameras)
    np.testing.assert_array_equal(first.colors, clip.first.colors)
    np.testing.assert_array_equal(state.points_m, clip.state.points_m)


def differences(seeds, kind: Kind, frames=17):
    """Return per script the target's maximum and last error, and the maximum error of others."""
    found = []
    for seed in seeds:
        rng = np.random.default_rng([seed, 0 if kind == "human" else 1])
        scene = sample_scene(rng)
        intent = hand_motion.choose(scene, rng)
        hands = (hand_motion.start_hand(scene, intent, kind, rng),)
        moments = hand_motion.act(scene, hands, intent, kind, frames=frames)
        joints = np.array([[h.grip.pose(kind, h.side)[0] for h in m.hands] for m in moments])
        cameras = next(make_sequence(3, spec=replace(SPEC, height=2, width=2))).cameras
        scenes, _ = World(scene=scene).move(act(cameras, joints, kind))
        gaps = {
            body.name: np.array(
                [
                    np.linalg.norm(
                        (a.scene.first_part_pose(body.name) - b.first_part_pose(body.name))[:3, 3]
                    )
                    for a, b in zip(moments, scenes, strict=True)
                ]
            )
            for body in scene.bodies
        }
        own = gaps.pop(intent.name)
        found.append((own.max(), own[-1], max(gap.max() for gap in gaps.values())))
    return np.array(found)


@pytest.mark.parametrize("kind", ["human", "robot"])
@pytest.mark.parametrize("seeds", [(1, 5), pytest.param(range(300, 320), marks=pytest.mark.slow)])
def test_scripted_clips_are_executed_as_scripted(kind, seeds):
    """Between two frames hands move in straight lines, scripts on smooth curves."""
    largest, last, others = differences(seeds, kind).T
    assert ((largest < 0.015) & (last < 0.01) & (others < 1e-3)).mean() >= 0.95


def test_a_hand_has_its_own_frame_and_side():
    for side in ("left", "right"):
        for closure in (0.0, 0.4, 0.9):
            joints = joints_of("human", closure, side)
            assert side_of(joints) == side
            axes = frame_of(joints, "human")[:3, :3]
            np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(axes) == pytest.approx(1)
