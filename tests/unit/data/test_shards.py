"""Shards: random access to records, named damage, and atomic writing."""

import os
import pickle

import numpy as np
import pytest

from egosim_jax.data.manifest import MANIFEST, read_manifest
from egosim_jax.data.records import RecordError
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.types import InputError
from tests.unit.data.latent_records import (
    damage_record,
    first_shard,
    latents,
    problems,
    rewrite_manifest,
)


def test_records_are_read_in_any_order(folder):
    reader = pickle.loads(pickle.dumps(ShardReader(folder)))  # noqa: S301
    assert [record.metadata["video_id"] for record in reader] == [f"clip{n}" for n in range(7)]
    for index in (-1, 7):
        with pytest.raises(IndexError):
            reader[index]
    for index in (6, 0, 3):
        record = reader[index]
        assert record.metadata == {"video_id": f"clip{index}", "prompt": f"é {index}"}
        for name, array in latents(index).items():
            assert record.arrays[name].tobytes() == array.tobytes()


def test_a_full_shard_is_followed_by_another(folder):
    manifest = read_manifest(folder)
    # A record takes about 3.2 kB, so 13,000 bytes hold four.
    assert [shard.records for shard in manifest.shards] == [4, 3]
    assert manifest.records == 7


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ({"y": np.zeros(3, np.uint8)}, "holds the arrays .'y'.; expected .'x'."),
        ({"x": np.zeros(3, np.float32)}, "x has dtype float32; expected uint8"),
        ({"x": np.zeros((3, 1), np.uint8)}, r"x has shape \(3, 1\); expected \(3,\)"),
        ({"x": np.zeros(3, np.complex64)}, "x has dtype complex64"),
    ],
)
def test_records_must_hold_the_same_arrays(tmp_path, second, message):
    def write():
        with ShardWriter(tmp_path, kind="latents") as writer:
            writer.add({"x": np.zeros(3, np.uint8)}, {"video_id": "a"})
            writer.add(second, {"video_id": "b"})

    with pytest.raises(InputError, match=message):
        write()


def test_no_record_is_neither_written_nor_read(tmp_path):
    with (
        pytest.raises(InputError, match="No record was written"),
        ShardWriter(tmp_path, kind="latents"),
    ):
        pass
    with pytest.raises(InputError, match=r"is not a dataset: it has no manifest\.json"):
        ShardReader(tmp_path)


def test_an_interrupted_writer_leaves_nothing(tmp_path):
    def write():
        with ShardWriter(tmp_path, kind="latents", shard_bytes=4000) as writer:
            writer.add(latents(0), {"video_id": "a"})
            writer.add(latents(1), {"video_id": "b"})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert list(tmp_path.iterdir()) == []


def test_shards_are_not_replaced_unasked(folder):
    with pytest.raises(InputError, match="--overwrite"):
        ShardWriter(folder, kind="latents")


def test_overwriting_replaces_all_of_the_old_shards(folder):
    with ShardWriter(folder, kind="latents", overwrite=True) as writer:
        writer.add(latents(9), {"video_id": "new"})
    assert [record.metadata["video_id"] for record in ShardReader(folder)] == ["new"]
    assert len(list(folder.iterdir())) == 2


def test_what_a_killed_writer_left_is_cleared_by_the_next(tmp_path):
    (tmp_path / "shard-00007.array_record.tmp").write_bytes(b"half a shard")
    with ShardWriter(tmp_path, kind="latents") as writer:
        writer.add(latents(0), {"video_id": "a"})
    assert {path.name for path in tmp_path.iterdir()} == {MANIFEST, "shard-00000.array_record"}


def test_the_old_shards_stay_until_the_new_ones_are_complete(folder):
    def write():
        with ShardWriter(folder, kind="latents", overwrite=True) as writer:
            writer.add(latents(9), {"video_id": "new"})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert len(ShardReader(folder)) == 7


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "missing"),
        (lambda path: path.write_bytes(b""), "0 bytes, expected"),
        (lambda path: path.write_bytes(path.read_bytes()[:1000]), "1000 bytes, expected"),
    ],
)
def test_a_missing_empty_or_truncated_shard_is_named_at_opening(folder, damage, message):
    damage(first_shard(folder))
    with pytest.raises(InputError, match=message) as caught:
        ShardReader(folder)
    assert str(first_shard(folder)) in str(caught.value)
    assert message in problems(folder)[0]


def test_a_flipped_byte_is_named_when_its_record_is_read(folder):
    damage_record(folder, 1)
    reader = ShardReader(folder)
    assert reader[0].metadata["video_id"] == "clip0"
    with pytest.raises(RecordError, match="record 1 cannot be read"):
        reader[1]


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "shard-1.array_record", ""])
def test_a_manifest_that_names_other_paths_is_refused(folder, name):
    rewrite_manifest(folder, lambda fields: fields["shards"][0].update(file=name))
    with pytest.raises(InputError, match="must list unique shards named like"):
        ShardReader(folder)


def test_a_shard_that_is_a_link_is_refused(folder):
    path = first_shard(folder)
    path.rename(folder / "elsewhere")
    path.symlink_to(folder / "elsewhere")
    with pytest.raises(InputError, match="missing"):
        ShardReader(folder)


def test_the_old_dataset_is_there_until_the_new_one_takes_its_place(folder, monkeypatch):
    """Stop at every disk operation: the folder holds the old dataset or the new one."""
    steps, seen, stop = 0, set(), 0

    def counted(name):
        real = getattr(os, name)

        def call(*arguments, **options):
            nonlocal steps
            seen.add(tuple(record.metadata["video_id"] for record in ShardReader(folder)))
            steps += 1
            if steps == stop:
                raise KeyboardInterrupt
            return real(*arguments, **options)

        monkeypatch.setattr(os, name, call)

    for name in ("fsync", "mkdir", "rename", "replace", "unlink"):
        counted(name)
    old = tuple(f"clip{index}" for index in range(7))
    while stop < 40:
        stop, steps = stop + 1, 0
        try:
            with ShardWriter(folder, kind="latents", overwrite=True) as writer:
                writer.add(latents(9), {"video_id": "new"})
        except KeyboardInterrupt:
            continue
        break
    assert seen <= {old, ("new",)}
    assert old in seen
    assert 3 < stop < 40


def test_every_file_reaches_the_disk_once(tmp_path, monkeypatch):
    synced = []
    real = os.fsync
    monkeypatch.setattr(
        os, "fsync", lambda fd: (synced.append(os.readlink(f"/proc/self/fd/{fd}")), real(fd))
    )
    with ShardWriter(tmp_path / "shards", kind="latents", shard_bytes=4000) as writer:
        for index in range(3):
            writer.add(latents(index), {"video_id": str(index)})
    shards = [name for name in synced if name.endswith(".array_record")]
    assert len(shards) == len(set(shards)) == 3
