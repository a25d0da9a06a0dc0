"""Played episode: clips, and the return to earlier moments."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import tabletop_start
from egosim_jax.interactive.play.moves import intent_of, perform
from egosim_jax.interactive.play.played_episode import PlayedEpisode
from egosim_jax.interactive.server.session import Session
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.state import snapshot
from egosim_jax.types import InputError
from tests.painted import VIDEO, ChunkPainter, PaintedWorld, Painter

STILL = np.zeros(6)


class Showing(Painter):
    """Painter of two groups of frames."""

    def stream(self, view, action, first_frame, seed):
        frames = self(view, action, first_frame, seed)
        yield frames[:1]
        yield frames[1:]


@pytest.fixture
def played(tmp_path):
    world = PaintedWorld(generator=Showing(), video=VIDEO, perception=None)
    start = tabletop_start(0, ActionSpec(camera=True), VIDEO)
    return PlayedEpisode(world, tmp_path, start, "right")


def carry(played, show=lambda frames, last: None):
    """Carry the suggested object to the suggested place."""
    name, place = played.goal
    scene = played.current_scene()
    intent = intent_of("carry", scene, name, place)
    poses = perform(scene, intent, played.hand, "right", VIDEO.frames)
    return played.step(poses, STILL, f"The right hand {intent.caption}", show)


def test_frames_are_shown_as_they_come_and_truth_is_filmed(played):
    shown = []
    timing = carry(played, lambda frames, last: shown.append((len(frames), last)))
    assert shown == [(1, False), (4, True)]
    assert 0 < timing.first_s <= timing.last_s <= timing.total_s
    now = played.now
    world, frames = now.truth.result()
    assert frames.shape == now.frames.shape
    assert now.caption.startswith("The right hand picks up the red box")
    name, _ = played.goal
    moved = world.scene.body(name).world_from_body - played.scene.body(name).world_from_body
    assert np.abs(moved).max() > 0.01


def test_the_account_of_a_clip_has_the_notes_and_what_moved(tmp_path):
    world = PaintedWorld(generator=Showing(), video=VIDEO, perception="classical")
    start = tabletop_start(0, ActionSpec(camera=True), VIDEO)
    played = PlayedEpisode(world, tmp_path, start, "right")
    assert played.account() == []
    carry(played)
    name, _ = played.goal
    *_, moved = played.account()
    assert moved.startswith(f"{name}: moved by ")
    played.go_to(0)
    assert played.account() == []


def test_a_moment_is_returned_to_and_its_future_is_forgotten_by_another_clip(played):
    first = snapshot.fingerprint(played.state)
    carry(played)
    carry(played)
    caption, row = played.now.caption, played.row
    played.go_to(0)
    assert snapshot.fingerprint(played.state) == first
    assert len(played.moments) == 3
    played.go_to(2)
    np.testing.assert_array_equal(played.row, row)
    assert played.now.caption == caption
    played.go_to(1)
    carry(played)
    assert len(played.moments) == 3
    with pytest.raises(InputError, match="no moment 3: choose one from 0 to 2"):
        played.go_to(3)


def test_what_was_played_is_recorded_and_can_be_simulated(played):
    carry(played)
    opened = Session(played.session.folder, played.world)
    assert opened.committed == 1
    np.testing.assert_array_equal(opened.result.frames, played.now.frames)
    episode = played.episode()
    start = played.moments[0].start
    simulator: Simulator = played.world.simulator(start)
    step = simulator.step(
        episode.state, episode.actions[0], seed=start.seed + 1, first_frame=episode.first_frame
    )
    np.testing.assert_array_equal(step.clip.frames, played.now.frames)


def test_the_preview_shows_the_hand(played):
    near = played.preview(played.hand, STILL)
    assert near.shape == (VIDEO.height, VIDEO.width, 3)
    lower = replace(played.hand, point_m=played.hand.point_m - [0, 0, 0.05])
    assert (played.preview(lower, STILL) != near).any()
    assert (played.preview(played.hand, np.array([0, 0, 0, 0, 0.2, 0])) != near).any()


def test_the_hand_is_steered_while_a_clip_is_made(tmp_path):
    world = PaintedWorld(generator=ChunkPainter(), video=VIDEO, perception=None)
    start = tabletop_start(0, ActionSpec(camera=True), VIDEO)
    steered, straight = (
        PlayedEpisode(world, tmp_path / name, start, "right") for name in ("a", "b")
    )
    there = replace(straight.hand, point_m=straight.hand.point_m + [0, 0.08, 0])
    shown = []
    timing = straight.steer(
        lambda: (there, STILL), "there", lambda frames, last: shown.append((len(frames), last))
    )
    assert shown == [(1, False), (2, False), (1, False), (1, True)]
    assert 0 < timing.first_s <= timing.last_s <= timing.total_s
    aims = iter([there, replace(there, point_m=there.point_m - [0.08, 0, 0])])
    steered.steer(lambda: (next(aims), STILL), "elsewhere", lambda frames, last: None)
    first, second = straight.now.frames, steered.now.frames
    np.testing.assert_array_equal(first[:3], second[:3])
    assert not np.array_equal(first[3:], second[3:])
    np.testing.assert_allclose(straight.hand.point_m, there.point_m, atol=1e-6)
    np.testing.assert_allclose(steered.hand.point_m, there.point_m - [0.08, 0, 0], atol=1e-6)
    assert steered.now.truth.result()[1].shape == second.shape
