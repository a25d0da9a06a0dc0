"""Mixtures of shards: proportions, order, resume and processes."""

import json
from collections import Counter

import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.data.loader import make_loader, one_pass
from egosim_jax.data.mixing import Mixture, open_shards, write_mixture
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.train.monitor import Samples
from egosim_jax.types import InputError


def write(folder, count, start, width=2):
    with ShardWriter(folder, kind="latents", shard_bytes=2000) as writer:
        for index in range(start, start + count):
            writer.add({"x": np.full((9, width), index, np.float32)}, {"video_id": f"clip{index}"})
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A mixture of records 0 to 11 and 12 to 16, with weights 3 to 1."""
    root = tmp_path_factory.mktemp("mixture")
    parts = {write(root / "large", 12, 0): 3.0, write(root / "small", 5, 12): 1.0}
    write_mixture(root / "both", parts)
    return root / "both"


def numbers(loader, batches):
    return [next(loader)["record"].tolist() for _ in range(batches)]


def test_samples_have_the_proportions_of_the_weights(folder):
    loader = make_loader(open_shards(folder), batch_size=8, seed=0)
    for batch in numbers(loader, 20):
        assert sum(number >= 12 for number in batch) == 2


def test_every_record_of_a_part_is_seen_before_any_is_seen_again(folder):
    seen = [n for batch in numbers(make_loader(open_shards(folder), batch_size=4, seed=1), 20)
            for n in batch]  # fmt: skip
    small, large = [n for n in seen if n >= 12], [n for n in seen if n < 12]
    assert Counter(small) == dict.fromkeys(range(12, 17), 4)
    assert sorted(large[:12]) == list(range(12))
    assert small[:5] != small[5:10]


def test_records_are_those_of_their_numbers(folder):
    batch = next(make_loader(open_shards(folder), batch_size=8, seed=2))
    np.testing.assert_array_equal(batch["x"][:, 0, 0], batch["record"])
    source = open_shards(folder)
    assert source[13].metadata["video_id"] == "clip13"
    assert "small" in source.name(13)
    assert len(source) == 17


def test_processes_share_the_sequence_of_one(folder):
    alone = numbers(make_loader(open_shards(folder), batch_size=4, seed=3), 6)
    shared = [
        numbers(make_loader(open_shards(folder), batch_size=4, seed=3, rows=range(first, 4, 2)), 6)
        for first in range(2)
    ]
    for batch, even, odd in zip(alone, *shared, strict=True):
        assert [batch[0::2], batch[1::2]] == [even, odd]


def test_a_restored_state_continues_and_one_of_other_weights_is_refused(folder, tmp_path):
    loader = make_loader(open_shards(folder), batch_size=4, seed=4)
    numbers(loader, 5)
    state = json.loads(json.dumps(loader.get_state()))
    after = numbers(loader, 8)
    again = make_loader(open_shards(folder), batch_size=4, seed=4)
    again.set_state(state)
    assert numbers(again, 8) == after
    parts = open_shards(folder).parts
    other = Mixture(folder, parts, (1.0, 1.0))
    with pytest.raises(InputError, match="weights"):
        make_loader(other, batch_size=4, seed=4).set_state(state)


def test_one_pass_has_every_record_once(folder):
    (batch,) = one_pass(open_shards(folder), batch_size=17)
    assert batch["record"].tolist() == list(range(17))


def test_parts_that_differ_and_bad_weights_are_refused(folder, tmp_path):
    first = ShardReader(write(tmp_path / "a", 2, 0))
    wide = ShardReader(write(tmp_path / "b", 2, 0, width=3))
    with pytest.raises(InputError, match="records differ: arrays"):
        Mixture(tmp_path, [first, wide], [1.0, 1.0])
    with pytest.raises(InputError, match="positive"):
        Mixture(tmp_path, [first], [0.0])
    with pytest.raises(InputError, match="holds shards"):
        write_mixture(first.folder, {first.folder: 1.0})
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "mixture.json").write_text('{"parts": [{"shards": "a"}]}', "utf-8")
    with pytest.raises(InputError, match="weight, a number"):
        open_shards(tmp_path / "c")


def test_a_training_without_sample_clips_is_refused_before_it_starts(folder):
    with pytest.raises(InputError, match="--samples must be at least 1, not 0"):
        Samples(model=configs.get("debug"), latents=folder, vae=folder, count=0)


def test_sample_clips_of_a_training_are_taken_from_a_mixture(folder):
    samples = Samples(model=configs.get("debug"), latents=folder, vae=folder, count=13)
    assert [record.metadata["video_id"] for record in samples._records][-2:] == ["clip11", "clip12"]
