"""Shards from DWM's caches equal shards from encoded videos."""

import dataclasses

import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.cli.triplets import FromCaches, ToDwm
from egosim_jax.configs.model import Networks
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.pack import pack, triplet_record
from egosim_jax.data.shards import ShardReader, ShardWriter
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


def test_caches_give_the_latents_of_their_videos_and_those_of_another_vae_are_refused(
    tmp_path, monkeypatch
):
    """DWM's caches are of the first line of a caption."""
    weights, others = tmp_path / "weights", tmp_path / "others"
    Networks.random(MODEL, seed=0).save(weights)
    Networks.random(MODEL, seed=1).save(others)
    with ShardWriter(tmp_path / "made", kind="frames", spec=SPEC, grid=MODEL.grid) as writer:
        for record in map(triplet_record, map(make_triplet, range(2))):
            writer.add(record.arrays, record.metadata)
    with monkeypatch.context() as patch:
        patch.setattr(configs, "get", lambda _: MODEL)
        options = {"caches": MODEL.name, "weights": weights}
        assert ToDwm(shards=tmp_path / "made", out=tmp_path, name="home", **options).run() == 0
    path = tmp_path / "dataset_files" / "home.txt"
    clips = read_metadata(path)
    list(pack(clips, out=tmp_path / "videos", spec=SPEC, provenance={}, grid=MODEL.grid))
    source = ShardReader(tmp_path / "videos")
    encode_shards(MODEL, weights, source=source, out=tmp_path / "encoded", stride=1, batch_size=1)
    expected = list(ShardReader(tmp_path / "encoded"))
    for caption in (tmp_path / "home" / "prompts_rewrite").iterdir():
        caption.write_text(caption.read_text("utf-8") + "Nothing else moves.\n", "utf-8")
    with pytest.raises(InputError, match=r"rewrite/0\.pt was made with other weights"):
        list(shard_caches(MODEL, weights, read_metadata(path), out=tmp_path / "whole"))
    with monkeypatch.context() as patch:
        patch.setattr(configs, "get", lambda _: MODEL)
        files = {"metadata": path, "out": tmp_path / "cached"}
        assert FromCaches(config=MODEL.name, weights=weights, **files).run() == 0
    records = list(ShardReader(tmp_path / "cached"))
    assert [record.metadata["prompt"] for record in records] == ["take cup 0", "take cup 1"]
    check_encoders(tmp_path / "cached", MODEL, weights)
    for record, wanted in zip(records, expected, strict=True):
        assert record.arrays.keys() == wanted.arrays.keys()
        for name, array in wanted.arrays.items():
            size = np.abs(array).max()
            np.testing.assert_allclose(record.arrays[name], array, atol=0.02 * size)
    with pytest.raises(InputError, match="made with other weights"):
        list(shard_caches(MODEL, others, clips, out=tmp_path / "refused"))
    assert not (tmp_path / "refused" / "manifest.json").exists()
    with pytest.raises(InputError, match="does not train on cached moments"):
        list(shard_caches(configs.get("dwm_tabletop"), weights, clips, out=tmp_path / "x"))
