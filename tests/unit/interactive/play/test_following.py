"""A followed hand grasps, its objects are foreseen, and its poses become clips."""

import threading
from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import tabletop_start
from egosim_jax.interactive.play.following import Following
from egosim_jax.interactive.play.moves import pre_grasp_pose
from egosim_jax.interactive.play.played_episode import PlayedEpisode
from egosim_jax.types import VideoSpec
from tests.own_hands import RATE, Wearer, way
from tests.painted import ChunkPainter, PaintedWorld, Painter

LARGE = VideoSpec(frames=17, height=96, width=160, fps=8)
FORESEEN = 10
"""Number of frames between two predictions."""


class Halves(ChunkPainter):
    """Painter of a clip in the chunks of the student."""

    chunk_frames = (1, 8, 8)


def begun(folder, seed, painter):
    """A new episode whose scene is from a seed."""
    world = PaintedWorld(generator=painter, video=LARGE, perception=None)
    start = tabletop_start(seed, ActionSpec(camera=True), LARGE)
    return PlayedEpisode(world, folder, start, "right")


def person_of(following, played, *, facing=True, noise=None):
    """The person whose hand is followed."""
    wearer = played.now.start.camera.world_from_camera[0, :3, :3]
    return Wearer(following.own.home, wearer, facing=facing, noise=noise)


def carried(played, name, rng, *, facing):
    """Return the object that follows a hand which pinches at an object, and the way of both.

    The place of the pinch is off by 12 mm, and a noisy network finds the joints.
    """
    following = Following(played)
    person = person_of(following, played, facing=facing, noise=rng)
    grip = pre_grasp_pose(played.scene, name, "right").point_m
    grip, goal = grip + rng.normal(0, 0.012, 3), grip + [0, 0.0, 0.12]
    number, pinched = None, False
    for index, (pose, pinches) in enumerate(way(following.own.home, grip, goal)):
        if pinched and not pinches:
            break
        following.see(person.joints(pose, pinches=pinches), index / RATE)
        if following.own.phase == "follow" and not following.recorder.live:
            following.begin(played)
        if index % FORESEEN == 0 and following.recorder.live:
            number = following.foresee()[0].held
        pinched |= pinches
    foresight = following.foresee()[0]
    moved = foresight.poses[number][:3, 3] if number in foresight.poses else np.zeros(3)
    return played.state.names.get(number), moved


def test_of_twenty_grasps_the_right_object_follows_in_eighteen(tmp_path):
    rng, right, grasps = np.random.default_rng(0), 0, 0
    for seed in count(1):
        played = begun(tmp_path, seed, Painter())
        loose = [b for b in played.scene.bodies if not (b.static or b.articulated)]
        for body in loose[: 20 - grasps]:
            name, moved = carried(played, body.name, rng, facing=seed % 2 == 0)
            right += name == body.name and moved[2] > 0.08
            grasps += 1
        played.close()
        if grasps == 20:
            break
    assert right >= 18


def test_a_pinch_of_nothing_closes_the_hand_where_it_is(tmp_path):
    played = begun(tmp_path, 1, Painter())
    following = Following(played)
    high = replace(following.own.home, point_m=np.array([0.2, 0.1, 0.3]))
    grasp = following.foresight.grasp(high)
    np.testing.assert_array_equal(grasp.point_m, high.point_m)
    assert grasp.closure > 0.5
    played.close()


def test_the_poses_become_clips_that_are_undone_and_made_again(tmp_path):
    played = begun(tmp_path, 1, Halves())
    following = Following(played)
    person, home = person_of(following, played), following.own.home
    clock = count()

    def see(seconds):
        for _ in range(round(seconds * RATE)):
            following.see(person.joints(home), next(clock) / RATE)
            if following.own.phase == "follow" and not following.recorder.live:
                following.begin(played)

    def take(number):
        see(1.1)
        return following.recorder.take(number), np.zeros(6)

    see(1.5)  # calibrates, and comes from where the episode begins
    assert following.recorder.wait_for_motion(0.0)
    shown = []
    played.follow(take, "", lambda frames, last: shown.append((len(frames), last)))
    assert sum(length for length, _ in shown) == 17
    assert shown[-1][1]
    following.committed(played)
    poses, _ = following.recorder.path()
    np.testing.assert_allclose(poses[0].point_m, played.hand.point_m, atol=1e-6)
    assert 2 < len(poses) < 10
    rows = played.session.rows(1)
    # 1 m/s at 8 frames per second, and the wrist turns about the fingertips
    assert np.linalg.norm(np.diff(rows[:, :3], axis=0), axis=1).max() < 1.0 / 8 + 0.05
    played.go_to(0)
    following.begin(played)
    np.testing.assert_allclose(following.recorder.pose.point_m, played.hand.point_m)
    played.close()


def test_a_pause_ends_the_wait_for_poses(tmp_path):
    played = begun(tmp_path, 1, Halves())
    recorder = Following(played).recorder
    recorder.resume(played.hand)
    timer = threading.Timer(0.2, recorder.pause)
    timer.start()
    poses = recorder.take(8)
    assert len(poses) == 8
    for pose in poses:
        np.testing.assert_array_equal(pose.point_m, played.hand.point_m)
    played.close()


@pytest.mark.parametrize("waiting", [8, 15, 40])
def test_a_slow_painter_does_not_fall_behind(tmp_path, waiting):
    played = begun(tmp_path, 1, Halves())
    recorder = Following(played).recorder
    recorder.resume(played.hand)
    far = replace(played.hand, point_m=played.hand.point_m + [0.0, 0.0, 2.0])
    recorder.see(far, 0.0)
    for number in range(1, waiting + 1):
        recorder.see(far, number / 8 + 1e-6)
    poses = recorder.take(8)
    seen = 16 if waiting >= 16 else 8
    way_m = poses[-1].point_m - played.hand.point_m
    assert way_m[2] == pytest.approx(min(seen / 8, 2.0), abs=1e-3)
    assert len(recorder.path()[0]) == 2 + (waiting - 8 if waiting >= 16 else waiting)
    played.close()
