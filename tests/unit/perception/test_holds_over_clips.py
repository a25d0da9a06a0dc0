"""Holds that last over several clips: the state remembers what each hand holds."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import invert, transform
from egosim_jax.perception.classical import ClassicalConfig
from egosim_jax.simulation.actions import slice_action
from egosim_jax.state.fuse import fuse
from egosim_jax.state.snapshot import load, save
from egosim_jax.types import Clip, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_action

SPEC = VideoSpec(frames=49, height=96, width=160, fps=8)
PARTS = (slice(0, 17), slice(16, 33), slice(32, 49))
"""Three clips of one hold: the hand closes in the first and opens in the last."""
CLOSER_M = 0.012
UP_M = np.array([0, 0, 0.1])


def step(clip, frames, state, *, hands=True):
    """Perceive a part of a clip, with or without its hands, and return the state after it."""
    action = slice_action(to_action(clip), frames.start, frames.stop)
    if not hands:
        action = replace(action, joints_m=np.full_like(action.joints_m, np.nan))
    seen = Clip(frames=clip.frames[frames], fps=SPEC.fps)
    return fuse(state, ClassicalConfig().build()(seen, action, state))


def points(state, clip):
    return state.points_m[state.object_ids == clip.body_ids[clip.target]].astype(float)


@pytest.mark.parametrize(
    ("kind", "seed"),
    [("human", 4), ("human", 8), ("human", 21), ("robot", 3)],
    ids=["a ball", "a lid", "a drawer", "a gripper"],
)
def test_an_object_follows_the_hand_until_it_is_put_down(tmp_path, kind, seed):
    clip = next(make_sequence(seed, spec=SPEC, kind=kind))
    target, path = clip.body_ids[clip.target], clip.world_from_body[clip.target]
    state = clip.state
    for number, frames in enumerate(PARTS):
        state = step(clip, frames, state)
        save(tmp_path / "state", state)
        state = load(tmp_path / "state")
        true = transform(path[frames.stop - 1] @ invert(path[0]), points(clip.state, clip))
        off = np.linalg.norm(points(state, clip).mean(axis=0) - true.mean(axis=0))
        assert off < CLOSER_M, (number, off)
        assert state.held == ({0: target} if number < 2 else {})
    assert np.linalg.norm(true - points(clip.state, clip), axis=1).mean() > 0.03


def test_a_steady_hand_with_something_else_in_it_carries_nothing():
    """A clip begins in the middle of a hold, and the state has another object in the hand."""
    clip = next(make_sequence(4, spec=SPEC))
    state, target = step(clip, PARTS[0], clip.state), clip.body_ids[clip.target]
    (elsewhere, *_) = set(np.unique(state.object_ids).tolist()) - {0, target}
    state = replace(state, held={0: elsewhere})
    gray = replace(clip, frames=np.full_like(clip.frames, 127))
    way = points(step(gray, PARTS[1], state), clip) - points(state, clip)
    assert np.linalg.norm(way.mean(axis=0)) < CLOSER_M


def test_a_hand_out_of_view_still_holds():
    clip = next(make_sequence(4, spec=SPEC))
    state = step(clip, PARTS[0], clip.state)
    after = step(clip, PARTS[1], state, hands=False)
    assert after.held == state.held == {0: clip.body_ids[clip.target]}


@pytest.mark.parametrize(("kind", "seed"), [("human", 1), ("robot", 3)])
def test_a_hand_that_closes_to_the_end_of_a_clip_holds_in_the_next(kind, seed):
    """A policy that gives one row a clip. The frames leave the object where it was."""
    clip = next(make_sequence(seed, spec=SPEC, kind=kind))
    target, joints = clip.body_ids[clip.target], clip.joints_m
    tips = joints[:, 0][:, [4, 8, 12] if kind == "human" else [1, 2]]
    opening = np.linalg.norm(tips[:, 0] - tips[:, 1:].mean(axis=1), axis=-1)
    last = int(np.argmax(opening <= opening.min() + 1e-3))
    closed, opened = joints[last], joints[int(np.argmax(opening[: last + 1]))]
    opened = opened + (closed - opened)[:, :1]
    share = np.linspace(0, 1, 17)[:, None, None, None]
    state = clip.state
    for hands, rise_m in ((opened + share * (closed - opened), 0), (closed + share * UP_M, 0.1)):
        action = slice_action(to_action(clip), 0, 17)
        poses = np.repeat(action.cameras.world_from_camera[:1], 17, axis=0)
        cameras = replace(action.cameras, world_from_camera=poses)
        action = replace(action, cameras=cameras, joints_m=hands)
        still = Clip(frames=np.repeat(clip.first.colors[None], 17, axis=0), fps=SPEC.fps)
        state = fuse(state, ClassicalConfig().build()(still, action, state))
        moved = points(state, clip).mean(axis=0) - points(clip.state, clip).mean(axis=0)
        np.testing.assert_allclose(moved, [0, 0, rise_m], atol=0.01)
        assert state.held == {0: target}
