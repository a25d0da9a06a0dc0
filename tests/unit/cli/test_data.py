"""`egosim data`: pack, check and stats, with their exit codes."""

import os
import resource
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from egosim_jax import configs
from egosim_jax.cli.data import Check, Look, Pack
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.io.atomic import LOCK
from egosim_jax.runtime.command import ExitCode, run_with_exit_codes
from egosim_jax.types import InputError, VideoGrid, VideoSpec


@pytest.fixture
def out(tmp_path):
    return tmp_path / "shards"


def test_pack_stores_each_clip_and_prints_the_folder(clips, out, capsys):
    assert Pack(metadata=clips, out=out).run() == ExitCode.DONE
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
        "target": (5, 16, 32, 3),
        "prior": (5, 16, 32, 3),
        "hands": (5, 16, 32, 3),
        "mask": (5, 16, 32),
        "first_frame": (16, 32, 3),
    }


@pytest.mark.parametrize("gone", ["video.mp4", "pc_mask_video.mp4", "first_frame.png"])
def test_pack_of_bad_clips_alone_prints_the_reason_of_each(clips, out, capsys, gone):
    for name in ("clip0", "clip1"):
        (clips.parent / name / gone).unlink()
    with pytest.raises(InputError, match="None of the 2 clips"):
        Pack(metadata=clips, out=out).run()
    shown = capsys.readouterr().err
    for name in ("clip0", "clip1"):
        assert f"({name}): {clips.parent}/{name}/{gone} cannot be read" in shown


def test_pack_refuses_to_replace_shards_unasked(clips, out):
    Pack(metadata=clips, out=out, where="split=test").run()
    assert [record.metadata["video_id"] for record in ShardReader(out)] == ["clip1"]
    with pytest.raises(InputError, match="--overwrite"):
        Pack(metadata=clips, out=out).run()


def test_check_prints_each_problem(clips, out, capsys):
    Pack(metadata=clips, out=out).run()
    capsys.readouterr()
    shard = out / "shard-00000.array_record"
    shard.write_bytes(shard.read_bytes()[:-1])
    assert Check(shards=out).run() == ExitCode.PARTIAL
    assert str(shard) in capsys.readouterr().out


def test_look_draws_the_first_clip_of_each_value_of_a_column(make_clips, out, tmp_path):
    Pack(metadata=make_clips(clips=5), out=out, size=(16, 32), num_frames=5).run()
    sheet = tmp_path / "sheet.png"
    look = Look(shards=out, out=sheet, by=("split",), streams=("target", "prior"), moments=3)
    assert look.run() == ExitCode.DONE
    with Image.open(sheet) as image:
        assert image.size == (3 * 240, 2 * (16 + 2 * 120))
    Look(shards=out, out=sheet, limit=4, streams=("hands",), moments=3, width=32).run()
    with Image.open(sheet) as image:
        drawn = np.asarray(image)
    assert drawn.shape == (4 * (16 + 16), 3 * 32, 3)
    np.testing.assert_array_equal(drawn[16:32, 32:64], ShardReader(out)[0].arrays["hands"][2])


def test_look_refuses_unknown_columns_and_latents(clips, out, tmp_path):
    Pack(metadata=clips, out=out, size=(16, 32), num_frames=5).run()
    with pytest.raises(InputError, match="no column verb; known: split"):
        Look(shards=out, out=tmp_path / "sheet.png", by=("verb",)).run()
    spec = VideoSpec(frames=5, height=16, width=32)
    latents = tmp_path / "latents"
    with ShardWriter(latents, kind="latents", spec=spec) as writer:
        writer.add(
            {"target": np.zeros((2, 2, 4, 16), np.float32)}, {"video_id": "a", "prompt": "b"}
        )
    with pytest.raises(InputError, match="holds latents"):
        Look(shards=latents, out=tmp_path / "sheet.png").run()


BAD_CLIPS = {
    "unknown codec": lambda path: path.write_bytes(
        path.read_bytes().replace(b"avc1", b"zzz9").replace(b"avcC", b"zzzC")
    ),
    "pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "missing": lambda path: path.unlink(),
}


@pytest.mark.parametrize("how", BAD_CLIPS)
def test_one_bad_clip_does_not_end_the_batch(clips, out, capsys, how):
    BAD_CLIPS[how](clips.parent / "clip0" / "hand_keypoint_video.mp4")
    assert Pack(metadata=clips, out=out).run() == ExitCode.PARTIAL
    assert "skipped: metadata.csv line 2 (clip0)" in capsys.readouterr().err
    assert [record.metadata["video_id"] for record in ShardReader(out)] == ["clip1"]


@pytest.mark.parametrize(
    ("options", "without"),
    [
        ({"num_frames": 9}, "--size"),
        ({"decoding": "official"}, "--size"),
        (
            {"size": (16, 32), "num_frames": 5, "fps": 30, "resampling": "stride"},
            "--resampling first, rate or step",
        ),
    ],
)
def test_pack_refuses_options_without_effect(clips, out, options, without):
    with pytest.raises(InputError, match=f"has no effect without {without}:"):
        Pack(metadata=clips, out=out, **options).run()
    assert not out.exists()


def refused(command, capsys):
    """Return the exit code and the last error line, which must not be in a traceback."""
    code = run_with_exit_codes(command.run)
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return code, error.splitlines()[-1]


def test_a_full_disk_is_one_line_and_leaves_the_old_dataset(clips, out, capsys):
    Pack(metadata=clips, out=out).run()
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        code, line = refused(Pack(metadata=clips, out=out, overwrite=True), capsys)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == ExitCode.FAILED
    assert "File too large" in line
    after = {path.name: path.read_bytes() for path in out.iterdir() if path.name != LOCK}
    assert after == before
    assert {path.name for path in out.parent.iterdir() if "tmp" in path.name} == set()


def test_pack_takes_the_latent_grid_of_a_model(make_clips, out, monkeypatch):
    clips = make_clips(1, frames=7, height=40, width=56)
    with pytest.raises(InputError, match="None of the 1 clips"):
        Pack(metadata=clips, out=out).run()
    grid = VideoGrid(temporal_stride=2, spatial_stride=4, patch=2)
    monkeypatch.setattr(configs, "get", lambda name: SimpleNamespace(grid=grid, video=VideoSpec()))
    assert Pack(metadata=clips, out=out, config="toy").run() == ExitCode.DONE
    assert ShardReader(out).manifest.grid == grid
    frames = out.with_name("frames")
    Pack(metadata=clips, out=frames, config="toy", size=(24, 40), num_frames=3).run()
    assert ShardReader(frames).manifest.grid == grid
