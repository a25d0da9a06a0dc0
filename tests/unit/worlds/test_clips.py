"""Static priors of tabletop clips show the scene of the first frame, and the hands' meshes."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.digest import fingerprint
from egosim_jax.rendering.reference import render, splat
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import (
    episode_of_sequence,
    make_sequence,
    to_episode,
    to_triplet,
)
from egosim_jax.worlds.tabletop.clips import POINT_PX, hand_video, static_video
from egosim_jax.worlds.tabletop.dataset import DatasetConfig, make_shards
from egosim_jax.worlds.tabletop.scene import FIRST_HAND

SPEC = VideoSpec(frames=5, height=48, width=80)


@pytest.fixture(scope="module")
def clips():
    return list(make_sequence(3, spec=SPEC, clips=2))


def test_the_world_draws_points_as_its_model_wants_them():
    assert configs.get("tabletop").point_px == POINT_PX


def test_a_prior_has_points_of_the_given_size():
    clip = next(make_sequence(3, spec=SPEC))
    for size in (1, 2):
        view = render(clip.state, clip.cameras, point_px=size)
        np.testing.assert_array_equal(to_triplet(clip, point_px=size).prior, view.frames)
        np.testing.assert_array_equal(to_triplet(clip, point_px=size).mask, view.mask)


def test_the_static_video_starts_as_the_clip_without_hands(clips):
    for clip in clips:
        assert (static_video(clip)[0] == clip.first.colors).all()


def test_the_static_video_shows_the_points_of_the_first_frame(clips):
    for clip in clips:
        static = static_video(clip).astype(int)
        _, index = splat(clip.state.points_m, clip.cameras, point_px=1)
        seen = index >= 0
        assert seen.mean() > 0.5
        off = np.abs(static[seen] - clip.state.colors[index[seen]]).max(axis=-1)
        assert np.median(off) <= 4


def test_static_video_and_clip_agree_where_nothing_happens(clips):
    for clip in clips:
        static = static_video(clip)
        still = (static == clip.frames).all(axis=-1)
        assert 0.2 < still.mean() < 1
        assert not still[clip.ids >= FIRST_HAND].mean() > 0.02


def test_hand_meshes_cover_the_hands(clips):
    for clip in clips:
        drawn = hand_video(clip).any(axis=-1)
        hands = (clip.ids >= FIRST_HAND) & ((clip.ids - FIRST_HAND) % 2 == 0)
        assert hands.sum() > 200
        assert drawn[hands].mean() > 0.75
        wide = clip.ids >= FIRST_HAND
        assert (drawn & ~wide).mean() < 0.05


def test_conditions_of_dwm_are_observed_everywhere(clips):
    clip = clips[1]
    given = to_triplet(clip)
    triplet = to_triplet(clip, prior="static", hands="mask")
    assert not triplet.mask.any()
    assert (triplet.first_frame == triplet.prior[0]).all()
    assert {*np.unique(triplet.hands)} == {0, 255}
    assert (triplet.target == given.target).all()
    plain = to_triplet(clip, prior="state", hands="skeleton")
    for name in ("prior", "mask", "hands", "first_frame", "target"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(given, name))


@pytest.mark.slow
def test_shards_hold_static_priors(tmp_path):
    small = VideoSpec(frames=5, height=32, width=48)
    config = DatasetConfig(
        seeds=(5,), clips=1, spec=small, kind="human", prior="static", hands="mesh"
    )
    list(make_shards(config, out=tmp_path, workers=1))
    reader = ShardReader(tmp_path)
    clip = next(make_sequence(5, spec=small))
    assert (reader[0].arrays["prior"] == static_video(clip)).all()
    assert (reader[0].arrays["hands"] == hand_video(clip)).all()
    assert reader.manifest.provenance["prior"] == "static"


def test_meshes_of_grippers_are_refused():
    with pytest.raises(InputError, match="--hands skeleton"):
        DatasetConfig(seeds=(1,), clips=1, spec=SPEC, kind="mixed", hands="mesh")
    clip = next(make_sequence(3, spec=VideoSpec(frames=1, height=32, width=48), kind="robot"))
    with pytest.raises(InputError, match="have no mesh"):
        hand_video(clip)


@pytest.mark.parametrize("kind", ["human", "robot"])
def test_an_episode_without_ground_truth_is_that_of_the_rendered_clips(kind):
    clips = list(make_sequence(1, spec=SPEC, clips=2, kind=kind))
    rendered = to_episode(clips, fps=SPEC.fps)
    quick = episode_of_sequence(1, spec=SPEC, clips=2, kind=kind)
    assert quick.ground_truth == ()
    assert fingerprint(quick) == fingerprint(replace(rendered, ground_truth=()))
