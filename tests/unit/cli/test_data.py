"""`egosim data`: pack, check and stats, with their exit codes."""

import numpy as np
import pytest
from PIL import Image

from egosim_jax.cli.data import Check, Look, Pack, Stats
from egosim_jax.command import DONE, PARTIAL
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.types import InputError, VideoSpec


@pytest.fixture
def out(tmp_path):
    return tmp_path / "shards"


def test_pack_stores_each_clip_and_prints_the_folder(clips, out, capsys):
    assert Pack(metadata=clips, out=out).run() == DONE
    assert capsys.readouterr().out.strip() == str(out)
    reader = ShardReader(out)
    assert reader.manifest.kind == "videos"
    assert [record.metadata["video_id"] for record in reader] == ["clip0", "clip1"]
    assert reader[1].metadata["extra"] == {"split": "test"}
    assert reader[1].metadata["prompt"] == "hands move, clip 1"


def test_pack_with_a_size_stores_decoded_frames(clips, out):
    Pack(metadata=clips, out=out, size=(16, 32), num_frames=5).run()
    reader = ShardReader(out)
    assert reader.manifest.spec == VideoSpec(frames=5, height=16, width=32)
    assert {name: array.shape for name, array in reader[0].arrays.items()} == {
        "truth": (5, 16, 32, 3),
        "prior": (5, 16, 32, 3),
        "hands": (5, 16, 32, 3),
        "mask": (5, 16, 32),
        "first_frame": (16, 32, 3),
    }


def test_pack_takes_the_selected_rows(clips, out):
    Pack(metadata=clips, out=out, where="split=test").run()
    assert [record.metadata["video_id"] for record in ShardReader(out)] == ["clip1"]


def test_pack_leaves_a_bad_clip_out_and_says_so(clips, out, capsys):
    (clips.parent / "clip0" / "pc_mask_video.mp4").unlink()
    assert Pack(metadata=clips, out=out).run() == PARTIAL
    assert "left out: metadata.csv line 2 (clip0): There is no file" in capsys.readouterr().err
    assert [record.metadata["video_id"] for record in ShardReader(out)] == ["clip1"]


def test_pack_of_bad_clips_alone_is_refused_and_leaves_nothing(clips, out):
    for name in ("clip0", "clip1"):
        (clips.parent / name / "video.mp4").unlink()
    with pytest.raises(InputError, match="None of the 2 clips could be packed"):
        Pack(metadata=clips, out=out).run()
    assert list(out.iterdir()) == []


def test_pack_refuses_to_replace_shards_unasked(clips, out):
    Pack(metadata=clips, out=out).run()
    with pytest.raises(InputError, match="--overwrite"):
        Pack(metadata=clips, out=out).run()


def test_check_of_sound_shards_prints_nothing(clips, out, capsys):
    Pack(metadata=clips, out=out).run()
    capsys.readouterr()
    assert Check(shards=out).run() == DONE
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "2 records in 1 shards: no problems" in captured.err


def test_check_prints_each_problem(clips, out, capsys):
    Pack(metadata=clips, out=out).run()
    capsys.readouterr()
    shard = out / "shard-00000.array_record"
    shard.write_bytes(shard.read_bytes()[:-1])
    assert Check(shards=out).run() == PARTIAL
    assert str(shard) in capsys.readouterr().out


def test_stats_name_kind_arrays_and_splits(clips, out, capsys):
    Pack(metadata=clips, out=out, size=(16, 32), num_frames=5).run()
    capsys.readouterr()
    assert Stats(shards=out).run() == DONE
    printed = capsys.readouterr().out
    for words in ("frames", "2 in 1 shards", "uint8 [5 16 32 3]", "5 frames of 32x16", "train"):
        assert words in printed


def test_progress_goes_to_stderr_and_ends_with_the_total(clips, out, capsys):
    Pack(metadata=clips, out=out).run()
    assert capsys.readouterr().err.splitlines()[-1] == "packing: 2/2"


def test_a_shard_of_no_size_is_refused(clips, out):
    with pytest.raises(InputError, match="--shard-megabytes must be at least 1, not 0"):
        Pack(metadata=clips, out=out, shard_megabytes=0).run()


def test_look_draws_the_first_clip_of_each_value_of_a_column(make_clips, out, tmp_path):
    Pack(metadata=make_clips(count=5), out=out, size=(16, 32), num_frames=5).run()
    sheet = tmp_path / "sheet.png"
    look = Look(shards=out, out=sheet, by=("split",), streams=("truth", "prior"), moments=3)
    assert look.run() == DONE
    with Image.open(sheet) as picture:
        assert picture.size == (3 * 240, 2 * (16 + 2 * 120))
    Look(shards=out, out=sheet, limit=4, streams=("hands",), moments=3, width=32).run()
    with Image.open(sheet) as picture:
        drawn = np.asarray(picture)
    assert drawn.shape == (4 * (16 + 16), 3 * 32, 3)
    np.testing.assert_array_equal(drawn[16:32, 32:64], ShardReader(out)[0].arrays["hands"][2])


def test_look_refuses_unknown_columns_and_latents(clips, out, tmp_path):
    Pack(metadata=clips, out=out, size=(16, 32), num_frames=5).run()
    with pytest.raises(InputError, match="no column verb; known: split"):
        Look(shards=out, out=tmp_path / "sheet.png", by=("verb",)).run()
    spec = VideoSpec(frames=5, height=16, width=32)
    latents = tmp_path / "latents"
    with ShardWriter(latents, kind="latents", spec=spec) as writer:
        writer.add({"truth": np.zeros((2, 2, 4, 16), np.float32)}, {"video_id": "a", "prompt": "b"})
    with pytest.raises(InputError, match="holds latents"):
        Look(shards=latents, out=tmp_path / "sheet.png").run()
