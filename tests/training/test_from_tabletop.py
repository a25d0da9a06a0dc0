"""Priors from states of a model's own rollouts."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egosim_jax.train import from_tabletop
from egosim_jax.train.from_tabletop import OwnRollouts
from egosim_jax.train.recipes import TABLETOP
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, state_after, to_episode

SPEC = VideoSpec(frames=5, height=48, width=80, fps=8)


@pytest.fixture(scope="module")
def clips():
    return list(make_sequence(3, spec=SPEC, clips=3))


def states_of(clips, monkeypatch, generate, perception) -> list[Any]:
    monkeypatch.setattr(
        from_tabletop, "load_generator", lambda config, weights: (generate, SPEC.fps)
    )
    make = OwnRollouts(config="tiny", weights=Path(), digests={}, perceptions=(perception,))
    return list(make(clips))


def test_every_clip_but_the_first_starts_from_what_was_perceived_in_those_before(
    clips, monkeypatch
):
    given = []

    def generate(view, action, first_frame, seed):
        given.append((first_frame, seed))
        return view.frames

    first, *others = states_of(clips, monkeypatch, generate, "oracle")
    assert first is None
    assert [state.step for state in others] == [1, 2]
    np.testing.assert_array_equal(given[0][0], to_episode(clips, fps=8).first_frame)
    assert [seed for _, seed in given] == [3000, 3001]
    body, want = clips[0].body_ids[clips[0].target], state_after(clips[0], clips[0].state)
    have, want = (x.points_m[x.object_ids == body] for x in (others[0], want))
    # The sides that are seen later are added, which moves the median.
    np.testing.assert_allclose(np.median(have, axis=0), np.median(want, axis=0), atol=0.02)


def test_classical_perception_reads_what_was_generated(clips, monkeypatch):
    def gray(view, action, first_frame, seed):
        return np.full_like(view.frames, 128)

    _, after, _ = states_of(clips, monkeypatch, gray, "classical")
    assert after.step == 1
    body = clips[0].body_ids[clips[0].target]
    moved, truth = after, state_after(clips[0], clips[0].state)
    have, want = (np.median(x.points_m[x.object_ids == body], axis=0) for x in (moved, truth))
    assert np.linalg.norm(have - want) > 0.005


def test_given_weights_are_trained_further_on_other_scenes(monkeypatch, tmp_path):
    made = {}

    def make(_, split, seeds, clips, out):
        made[split] = seeds
        return out / split

    monkeypatch.setattr(type(TABLETOP), "_make", make)
    replace(TABLETOP, first_scene=2000, scenes=30, rollouts=5, weights=Path()).frames(tmp_path)
    assert made == {"train": range(2000, 2030), "test": range(48), "rollouts": range(2030, 2035)}


@pytest.mark.parametrize(
    ("options", "message"),
    [({"rollouts": 4}, "--rollouts, --weights"), ({"first_scene": 999}, "at least 1000, not 999")],
)
def test_rollouts_without_a_model_and_held_out_scenes_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        replace(TABLETOP, **options)
