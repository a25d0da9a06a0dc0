"""Attempts follow the true world: only held bodies move, and the head turns."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import attempts, make_sequence, to_triplet
from egosim_jax.worlds.tabletop.attempts import TURN_DEGREES, make_attempts
from egosim_jax.worlds.tabletop.dataset import DatasetConfig
from egosim_jax.worlds.tabletop.policies import POLICIES

SPEC = VideoSpec(frames=5, height=32, width=48, fps=8)


def test_a_policy_that_never_closes_its_hand_moves_nothing(monkeypatch):
    monkeypatch.setattr(attempts, "POLICIES", POLICIES[-1:])
    clip = next(make_attempts(1, spec=SPEC))
    for path in clip.world_from_body.values():
        np.testing.assert_allclose(path, np.broadcast_to(path[:1], path.shape), atol=1e-3)


def test_the_exact_policy_carries_a_body(monkeypatch):
    monkeypatch.setattr(attempts, "POLICIES", POLICIES[:1])
    clip = next(make_attempts(1, spec=replace(SPEC, frames=17)))
    path = clip.world_from_body[clip.target]
    assert np.linalg.norm(path[-1, :3, 3] - path[0, :3, 3]) > 0.08


def test_the_head_then_turns_away_and_back_without_hands():
    first, away, back = make_attempts(1, spec=SPEC, clips=3)
    for before, after in ((first, away), (away, back)):
        np.testing.assert_allclose(
            before.cameras.world_from_camera[-1], after.cameras.world_from_camera[0], atol=1e-9
        )
    starts, ends = away.cameras.world_from_camera[[0, -1]]
    angle = np.degrees(np.arccos((np.trace(starts[:3, :3].T @ ends[:3, :3]) - 1) / 2))
    assert TURN_DEGREES[0] <= angle <= TURN_DEGREES[1]
    np.testing.assert_allclose(back.cameras.world_from_camera[-1], starts, atol=1e-9)
    assert not np.isfinite(away.joints_m).any()
    triplet = to_triplet(away)
    assert triplet.hands.max() == 0
    assert triplet.mask[-1].mean() > triplet.mask[0].mean()  # next to the table nothing is observed


def test_a_scene_without_a_body_to_carry_has_scripted_clips(monkeypatch):
    monkeypatch.setattr(attempts, "MAX_TRIES", 0)
    (clip,) = make_attempts(3, spec=SPEC)
    np.testing.assert_array_equal(clip.frames, next(make_sequence(3, spec=SPEC)).frames)


@pytest.mark.parametrize(("share", "expected"), [(0.0, 0), (0.5, 5), (1.0, 16)])
def test_attempts_are_the_requested_fraction_of_scenes(monkeypatch, share, expected):
    monkeypatch.setattr(
        "egosim_jax.worlds.tabletop.dataset.make_attempts", lambda *a, **k: iter(["attempt"])
    )
    monkeypatch.setattr(
        "egosim_jax.worlds.tabletop.dataset.make_sequence", lambda *a, **k: iter(["script"])
    )
    plan = DatasetConfig(seeds=(0,), clips=1, spec=SPEC, kind="mixed", attempts=share)
    found = [str(next(plan.clips_of(seed))) for seed in range(16)]
    assert found.count("attempt") == expected


@pytest.mark.parametrize("more", [{"attempts": 1.5}, {"attempts": 0.5, "fixed_camera": True}])
def test_an_invalid_fraction_or_a_fixed_camera_is_refused(more):
    with pytest.raises(InputError, match="--attempts"):
        DatasetConfig(seeds=(0,), clips=1, spec=SPEC, kind="human", **more)
