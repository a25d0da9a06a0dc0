"""Shards: records survive bit for bit, and damage is named."""

import json
import os
import pickle

import ml_dtypes
import numpy as np
import pytest
import safetensors.numpy

from egosim_jax.data.check import check
from egosim_jax.data.manifest import MANIFEST, SEAL, read_manifest
from egosim_jax.data.records import Record, RecordError, from_bytes, to_bytes
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.io.video import encode_video
from egosim_jax.types import InputError, VideoSpec

SPEC = VideoSpec(frames=9, height=32, width=48)


def latents(index, shape=(3, 4, 6, 16)):
    rng = np.random.default_rng(index)
    return {
        "target": rng.standard_normal(shape).astype(ml_dtypes.bfloat16),
        "mask": rng.integers(0, 2, (3, 4, 6, 4)).astype(np.uint8),
        "text": rng.standard_normal((5, 8)).astype(np.float32),
    }


@pytest.fixture
def folder(tmp_path):
    """Seven records of latents in several shards."""
    with ShardWriter(
        tmp_path / "shards",
        kind="latents",
        spec=SPEC,
        provenance={"vae": "abc"},
        shard_bytes=13_000,
    ) as writer:
        for index in range(7):
            writer.add(latents(index), {"video_id": f"clip{index}", "prompt": f"é {index}"})
    return tmp_path / "shards"


def rewrite_manifest(folder, change):
    fields = json.loads((folder / MANIFEST).read_text())
    del fields[SEAL]  # as in a manifest of an earlier version, or of a liar
    change(fields)
    (folder / MANIFEST).write_text(json.dumps(fields))


def first_shard(folder):
    return folder / "shard-00000.array_record"


def problems(folder):
    return [problem for _, found in check(folder) for problem in found]


@pytest.mark.parametrize(
    "dtype", [np.uint8, np.int32, np.int64, np.float16, np.float32, np.bool_, ml_dtypes.bfloat16]
)
def test_a_record_survives_bit_for_bit(dtype):
    array = np.arange(24).reshape(2, 3, 4).astype(dtype)
    record = Record(arrays={"x": array}, metadata={"video_id": "a", "extra": {"split": "é"}})
    back = from_bytes(to_bytes(record))
    assert back.metadata == record.metadata
    assert back.arrays["x"].dtype == array.dtype
    assert back.arrays["x"].shape == array.shape
    assert back.arrays["x"].tobytes() == array.tobytes()


def test_a_transposed_array_keeps_its_order():
    array = np.arange(6, dtype=np.int32).reshape(2, 3).T
    back = from_bytes(to_bytes(Record(arrays={"x": array}, metadata={})))
    np.testing.assert_array_equal(back.arrays["x"], array)


@pytest.mark.parametrize(
    "data", [b"", b"short", bytes(64), to_bytes(Record(arrays={}, metadata={}))[:-1]]
)
def test_bytes_that_are_no_record_are_refused(data):
    with pytest.raises(RecordError, match="is not a valid record"):
        from_bytes(data)


def test_records_are_read_in_any_order(folder):
    reader = ShardReader(folder)
    assert len(reader) == 7
    for index in (6, 0, 3):
        record = reader[index]
        assert record.metadata == {"video_id": f"clip{index}", "prompt": f"é {index}"}
        for name, array in latents(index).items():
            assert record.arrays[name].tobytes() == array.tobytes()


def test_iterating_ends_after_the_last_record(folder):
    ids = [record.metadata["video_id"] for record in ShardReader(folder)]
    assert ids == [f"clip{index}" for index in range(7)]


@pytest.mark.parametrize("index", [-1, 7])
def test_there_is_no_record_beyond_the_ends(folder, index):
    with pytest.raises(IndexError):
        ShardReader(folder)[index]


def test_a_reader_can_be_pickled(folder):
    reader = pickle.loads(pickle.dumps(ShardReader(folder)))  # noqa: S301
    assert reader[5].metadata["video_id"] == "clip5"


def test_a_full_shard_is_followed_by_another(folder):
    manifest = read_manifest(folder)
    # A record takes about 3.2 kB, so 13,000 bytes hold four.
    assert [shard.records for shard in manifest.shards] == [4, 3]
    assert manifest.records == 7


def test_the_manifest_describes_the_records(folder):
    manifest = read_manifest(folder)
    assert (manifest.kind, manifest.spec, manifest.provenance) == ("latents", SPEC, {"vae": "abc"})
    assert manifest.arrays["target"].dtype == "bfloat16"
    assert manifest.arrays["target"].shape == (3, 4, 6, 16)


def test_axes_on_which_records_differ_are_none(tmp_path):
    with ShardWriter(tmp_path, kind="videos") as writer:
        writer.add({"x": np.zeros((2, 3), np.uint8)}, {"video_id": "a"})
        writer.add({"x": np.zeros((2, 5), np.uint8)}, {"video_id": "b"})
        writer.add({"x": np.zeros((2, 3), np.uint8)}, {"video_id": "c"})
    assert read_manifest(tmp_path).arrays["x"].shape == (2, None)


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


def test_an_interrupted_writer_leaves_nothing(tmp_path):
    def write():
        with ShardWriter(tmp_path, kind="latents", shard_bytes=4000) as writer:
            writer.add(latents(0), {"video_id": "a"})
            writer.add(latents(1), {"video_id": "b"})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_manifest_is_not_a_dataset(folder):
    (folder / MANIFEST).unlink()
    with pytest.raises(InputError, match=r"is not a dataset: it has no manifest\.json"):
        ShardReader(folder)


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


def test_writing_no_record_is_refused(tmp_path):
    with (
        pytest.raises(InputError, match="No record was written"),
        ShardWriter(tmp_path, kind="latents"),
    ):
        pass


def test_valid_shards_have_no_problems(folder):
    assert problems(folder) == []


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


def flip(path, position):
    data = bytearray(path.read_bytes())
    data[position] ^= 0xFF
    path.write_bytes(data)


def test_a_flipped_byte_is_named_when_its_record_is_read(folder):
    path = first_shard(folder)
    # Past the first record, within the second one's arrays.
    flip(path, path.read_bytes().index(to_bytes(ShardReader(folder)[1])[200:300]))
    reader = ShardReader(folder)
    assert reader[0].metadata["video_id"] == "clip0"
    with pytest.raises(RecordError, match="record 1 cannot be read"):
        reader[1]


def test_check_names_a_flipped_byte(folder):
    path = first_shard(folder)
    flip(path, path.read_bytes().index(to_bytes(ShardReader(folder)[1])[200:300]))
    found = problems(folder)
    assert found[0] == f"{path}: its SHA-256 differs from the manifest"
    assert found[1].startswith(f"{path}, record 1: cannot be read")
    assert len(found) == 2


def test_check_names_a_file_that_is_no_array_record(folder):
    path = first_shard(folder)
    path.write_bytes(b"x" * path.stat().st_size)
    assert f"{path}: 0 records, expected 4" in problems(folder)


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda fields: fields.update(version=2), "version 2"),
        (lambda fields: fields.update(kind="pickles"), "kind 'pickles'"),
        (lambda fields: fields.pop("shards"), "is not a manifest"),
        (lambda fields: fields.update(shards=[]), "at least one record"),
        (lambda fields: fields["shards"][0].update(records=0), "at least one record"),
        (lambda fields: fields["spec"].update(frames=10), "4k[+]1"),
        (lambda fields: fields["spec"].update(run="rm"), "is not a manifest"),
        (lambda fields: fields.update(arrays=3), "is not a manifest"),
    ],
)
def test_a_bad_manifest_is_refused(folder, change, message):
    rewrite_manifest(folder, change)
    with pytest.raises(InputError, match=message):
        read_manifest(folder)


def test_a_manifest_that_is_not_json_is_refused(folder):
    (folder / MANIFEST).write_text("{")
    with pytest.raises(InputError, match=r"manifest\.json is not valid JSON"):
        read_manifest(folder)


def test_a_dataset_that_calls_the_target_truth_is_read(tmp_path):
    arrays = {("truth" if name == "target" else name): a for name, a in latents(0).items()}
    with ShardWriter(tmp_path / "old", kind="latents", spec=SPEC) as writer:
        writer.add(arrays, {"video_id": "a", "prompt": ""})
    reader = ShardReader(tmp_path / "old")
    assert sorted(reader.manifest.arrays) == sorted(reader[0].arrays) == ["mask", "target", "text"]
    np.testing.assert_array_equal(reader[0].arrays["target"], arrays["truth"])
    assert problems(tmp_path / "old") == []


def test_check_names_a_wrong_record_count(folder):
    rewrite_manifest(folder, lambda fields: fields["shards"][0].update(records=3))
    assert problems(folder) == [f"{first_shard(folder)}: 4 records, expected 3"]


def test_check_names_arrays_that_are_not_as_the_manifest_says(folder):
    def change(fields):
        fields["arrays"]["text"]["shape"] = [5, 9]
        fields["arrays"]["mask"]["dtype"] = "int32"
        fields["arrays"]["hands"] = fields["arrays"].pop("target")

    rewrite_manifest(folder, change)
    found = "\n".join(problems(folder))
    assert "text is float32 (5, 8), expected float32 (5, 9)" in found
    assert "mask is uint8 (3, 4, 6, 4), expected int32" in found
    assert "target is missing in the manifest" in found
    assert "hands is missing in the record" in found


def test_check_names_numbers_that_are_not_finite(tmp_path):
    arrays = latents(0)
    arrays["target"][0, 0, 0, 0] = np.nan
    with ShardWriter(tmp_path, kind="latents") as writer:
        writer.add(arrays, {"video_id": "a"})
    assert problems(tmp_path) == [
        f"{first_shard(tmp_path)}, record 0: target has values that are not finite"
    ]


def test_check_names_an_id_that_is_a_path(tmp_path):
    with ShardWriter(tmp_path, kind="latents") as writer:
        writer.add(latents(0), {"video_id": "../../etc/x"})
    assert "'../../etc/x' is not a valid file name" in problems(tmp_path)[0]


def as_bytes(frames):
    return np.frombuffer(encode_video(np.zeros((frames, 32, 48, 3), np.uint8), 16), np.uint8)


@pytest.mark.parametrize(
    ("prior", "hands", "message"),
    [
        (as_bytes(10), as_bytes(10), "prior of 10 frames cannot be encoded"),
        (as_bytes(9), as_bytes(5), "the frame counts disagree"),
        (as_bytes(9), np.zeros(99, np.uint8), "hands is not a readable video"),
    ],
)
def test_check_decodes_every_video(tmp_path, prior, hands, message):
    with ShardWriter(tmp_path, kind="videos") as writer:
        writer.add({"prior": prior, "hands": hands}, {"video_id": "a"})
    assert any(message in problem for problem in problems(tmp_path))


def test_check_decodes_every_image(tmp_path):
    with ShardWriter(tmp_path, kind="videos") as writer:
        writer.add({"first_frame": np.zeros(99, np.uint8)}, {"video_id": "a"})
    assert "first_frame is not a readable image" in problems(tmp_path)[0]


def test_the_old_dataset_is_there_until_the_new_one_takes_its_place(folder, monkeypatch):
    """Stop at every step on the disk: what is there is the old dataset or the new one."""
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


@pytest.mark.parametrize(
    "change",
    [
        lambda fields: fields["provenance"].update(vae="abd"),
        lambda fields: fields["shards"][0].update(sha256="0" * 64),
        lambda fields: fields["spec"].update(frames=13),
        lambda fields: fields["arrays"]["target"].update(shape=[None]),
        lambda fields: fields["shards"].reverse(),
    ],
)
def test_a_changed_manifest_is_named(folder, change):
    fields = json.loads((folder / MANIFEST).read_text())
    change(fields)
    (folder / MANIFEST).write_text(json.dumps(fields))
    with pytest.raises(InputError, match="was modified after it was written"):
        read_manifest(folder)


@pytest.mark.parametrize(
    "change",
    [
        lambda fields: fields["shards"][0].update(records="4"),
        lambda fields: fields["shards"][0].update(size=1e300),
        lambda fields: fields["shards"].append(fields["shards"][0]),
        lambda fields: fields["arrays"]["target"].update(shape=["x"]),
        lambda fields: fields["arrays"]["target"].update(dtype=["x"]),
        lambda fields: fields["spec"].update(frames="9"),
        lambda fields: fields.update(provenance=[]),
        lambda fields: fields.update(kind=["latents"]),
        lambda fields: fields.update(version=[1]),
        lambda fields: fields.update(spec=[1]),
    ],
)
def test_a_manifest_of_wrong_types_is_refused(folder, change):
    rewrite_manifest(folder, change)
    with pytest.raises(InputError):
        read_manifest(folder)


@pytest.mark.parametrize("text", ["[]", "3", '{"version": 1}', "[" * 100_000, "\ud800"])
def test_an_invalid_manifest_is_refused(folder, text):
    (folder / MANIFEST).write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(InputError):
        read_manifest(folder)


@pytest.mark.parametrize(
    "metadata", [[], {"video_id": 3}, {"extra": []}, {"extra": {"a": 1}}, {"prompt": None}]
)
def test_a_record_of_wrong_types_is_refused(metadata):
    header = {"json": json.dumps(metadata)}
    data = safetensors.numpy.save({"x": np.zeros(2, np.float32)}, metadata=header)
    with pytest.raises(RecordError, match="is not a valid record"):
        from_bytes(data)
