"""Shards made of DWM's caches are those that encoding the videos makes."""

import dataclasses

import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.data.dwm import write_folders
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.moments import cache_of, write_moments
from egosim_jax.data.pack import pack
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.pth import write_pth
from egosim_jax.networks import Networks
from egosim_jax.train.cached import shard_caches
from egosim_jax.train.encode import check_encoders, encode_shards
from egosim_jax.types import InputError, Triplet, VideoSpec

pytestmark = pytest.mark.slow
SPEC = VideoSpec(frames=9, height=32, width=48, fps=8)
MODEL = dataclasses.replace(
    configs.get("dwm_tabletop"), encoders="frozen", posterior="sampled", video=SPEC
)


def make_triplet(number):
    rng = np.random.default_rng(number)
    prior, hands, target = rng.integers(0, 256, (3, 9, 32, 48, 3)).astype(np.uint8)
    mask = np.zeros((9, 32, 48), np.uint8)
    return Triplet(
        video_id=f"{number}",
        prompt=f"take cup {number}",
        prior=prior,
        mask=mask,
        hands=hands,
        first_frame=prior[0],
        target=target,
    )


def test_caches_give_the_latents_of_their_videos_and_those_of_another_vae_are_refused(tmp_path):
    weights, others = tmp_path / "weights", tmp_path / "others"
    Networks.random(MODEL, seed=0).save(weights)
    Networks.random(MODEL, seed=1).save(others)
    path = write_folders(tmp_path, [make_triplet(n) for n in range(2)], name="home", fps=8)
    clips = read_metadata(path)
    list(pack(clips, out=tmp_path / "videos", spec=SPEC, provenance={}, grid=MODEL.grid))
    source = ShardReader(tmp_path / "videos")
    encode_shards(MODEL, weights, source=source, out=tmp_path / "encoded", stride=1, batch_size=1)
    expected = list(ShardReader(tmp_path / "encoded"))
    for clip, record in zip(clips, expected, strict=True):
        for name in ("target", "prior", "hands"):
            mean, std = (record.arrays[f"{name}{end}"] / 0.7 for end in ("", "_std"))
            cache = cache_of(clip.target, name)
            cache.parent.mkdir(exist_ok=True)
            write_moments(cache, mean, 2 * np.log(std))
        cache_of(clip.target, "text").parent.mkdir(exist_ok=True)
        write_pth(cache_of(clip.target, "text"), record.arrays["text"])
    ids = list(shard_caches(MODEL, weights, clips, out=tmp_path / "cached"))
    assert ids == ["home_videos_0", "home_videos_1"]
    check_encoders(tmp_path / "cached", MODEL, weights)
    for record, wanted in zip(ShardReader(tmp_path / "cached"), expected, strict=True):
        assert record.arrays.keys() == wanted.arrays.keys()
        for name, array in wanted.arrays.items():
            size = np.abs(array).max()
            np.testing.assert_allclose(record.arrays[name], array, atol=0.02 * size)
    with pytest.raises(InputError, match="not of these weights"):
        list(shard_caches(MODEL, others, clips, out=tmp_path / "refused"))
    assert not (tmp_path / "refused" / "manifest.json").exists()
    with pytest.raises(InputError, match="does not train on cached moments"):
        list(shard_caches(configs.get("dwm_tabletop"), weights, clips, out=tmp_path / "x"))
