"""Clips are read at a model's length and size, strictly or as the EgoSim release does."""

import dataclasses
import io
import os
import subprocess
import sys
from fractions import Fraction

import av
import numpy as np
import pytest
from PIL import Image

from egosim_jax.data.clip_files import prior_column, prior_problem
from egosim_jax.data.clips import check_clip, load_triplet, write_clips
from egosim_jax.data.metadata import csv_rows, read_metadata
from egosim_jax.io.images import read_image
from egosim_jax.io.video import read_video
from egosim_jax.io.writing import write_video
from egosim_jax.types import InputError, Triplet, VideoSpec

NATIVE = VideoSpec(frames=9, height=32, width=48)


@pytest.fixture
def files(clips):
    return read_metadata(clips)[0]


def rewrite(path, *part):
    """Keep a part of the frames, rows and columns of a video."""
    write_video(path, read_video(path).frames[part], 16)


def test_a_clip_of_the_models_size_passes_unchanged(files):
    triplet = load_triplet(files, NATIVE)
    assert (triplet.video_id, triplet.prompt) == ("clip0", "hands move, clip 0")
    assert triplet.extra == {"split": "train"}
    np.testing.assert_array_equal(triplet.prior, read_video(files.prior).frames)
    np.testing.assert_array_equal(triplet.hands, read_video(files.hands).frames)
    np.testing.assert_array_equal(triplet.target, read_video(files.target).frames)
    np.testing.assert_array_equal(triplet.mask, read_video(files.mask).frames[..., 0])
    np.testing.assert_array_equal(triplet.first_frame, read_image(files.first_frame))


def test_colors_are_stretched_with_lanczos(files):
    triplet = load_triplet(files, dataclasses.replace(NATIVE, height=16, width=32))
    frame = Image.fromarray(read_video(files.prior).frames[3])
    expected = frame.resize((32, 16), Image.Resampling.LANCZOS)
    np.testing.assert_array_equal(triplet.prior[3], np.asarray(expected))


def test_the_mask_is_channel_0_of_the_bilinear_frames(files):
    triplet = load_triplet(files, dataclasses.replace(NATIVE, height=16, width=32))
    frame = Image.fromarray(read_video(files.mask).frames[3])
    expected = np.asarray(frame.resize((32, 16), Image.Resampling.BILINEAR))[..., 0]
    np.testing.assert_array_equal(triplet.mask[3], expected)


def test_a_portrait_is_not_stretched_to_a_landscape_unless_it_is_wanted(files):
    tall = dataclasses.replace(NATIVE, height=64, width=32)
    (problem, *_) = check_clip(files, tall)
    assert "48x32 pixels would be stretched to 32x64: one side by 3 times" in problem
    with pytest.raises(InputError, match="stretched"):
        load_triplet(files, tall)
    assert check_clip(files, tall, policy="lenient") == []
    assert load_triplet(files, tall, policy="lenient").prior.shape[1:3] == (64, 32)


def test_the_first_frame_may_be_a_video(files):
    files = dataclasses.replace(files, first_frame=files.target)
    np.testing.assert_array_equal(
        load_triplet(files, NATIVE).first_frame, read_video(files.target).frames[0]
    )


def test_a_valid_clip_has_no_problems_also_without_truth(files):
    assert check_clip(files, NATIVE) == []
    assert load_triplet(dataclasses.replace(files, target=None), NATIVE).target is None


@pytest.mark.parametrize("name", ["prior", "hands", "mask", "first_frame", "target"])
def test_strict_refuses_a_missing_file_by_row_and_path(files, name):
    path = getattr(files, name)
    path.unlink()
    assert check_clip(files, NATIVE) == [
        f"metadata.csv line 2 (clip0): {path} cannot be read: No such file or directory."
    ]


def shorten(files):
    rewrite(files.hands, slice(5))


def shrink(files):
    rewrite(files.hands, slice(9), slice(16))


@pytest.mark.parametrize(
    ("clip", "change", "start", "message"),
    [
        ({}, shorten, 0, r"disagree: prior 9, hands 5, mask 9, target 9.*\(egosim gen"),
        ({}, shrink, 0, "disagree: prior 48x32, hands 48x16"),
        ({}, lambda files: cut_off(files.hands), 0, r"metadata\.csv line 2 \(clip0\).*is cut off"),
        ({}, lambda files: files.prior.write_bytes(b"x"), 0, "prior.*is not a readable video"),
        ({}, None, 3, "9 frames are fewer than the 12"),
        ({"frames": 10}, None, 0, "10 frames cannot be encoded.*Nearest: 9 or 13"),
        ({"height": 24}, None, 0, "48x24 pixels: width and height must be multiples of 16"),
    ],
)
def test_strict_refuses_a_clip_that_would_have_to_be_changed(
    make_clips, clip, change, start, message
):
    (files,) = read_metadata(make_clips(clips=1, **clip))
    if change is not None:
        change(files)
    with pytest.raises(InputError, match=message):
        load_triplet(files, NATIVE, start=start)


def test_lenient_repeats_the_last_frame(files):
    rewrite(files.hands, slice(6))
    hands = load_triplet(files, NATIVE, policy="lenient").hands
    have = read_video(files.hands).frames
    np.testing.assert_array_equal(hands, have[[0, 1, 2, 3, 4, 5, 5, 5, 5]])


def test_lenient_cuts(files):
    rewrite(files.prior, slice(6))
    triplet = load_triplet(files, dataclasses.replace(NATIVE, frames=5), policy="lenient")
    np.testing.assert_array_equal(triplet.prior, read_video(files.prior).frames[:5])


def test_lenient_resizes_each_video(files):
    rewrite(files.hands, slice(None), slice(16), slice(32))
    hands = load_triplet(files, NATIVE, policy="lenient").hands
    frame = Image.fromarray(read_video(files.hands).frames[0])
    expected = frame.resize((48, 32), Image.Resampling.LANCZOS)
    np.testing.assert_array_equal(hands[0], np.asarray(expected))


def test_lenient_takes_a_missing_mask_for_all_observed(files):
    files.mask.unlink()
    mask = load_triplet(files, NATIVE, policy="lenient").mask
    assert mask.shape == (9, 32, 48)
    assert not mask.any()


def test_lenient_does_without_a_missing_truth_but_not_without_a_prior(files):
    files.target.unlink()
    assert load_triplet(files, NATIVE, policy="lenient").target is None
    files.prior.unlink()
    with pytest.raises(InputError, match="No such file"):
        load_triplet(files, NATIVE, policy="lenient")


def test_clips_that_were_written_are_read_back(tmp_path):
    """Return True if smooth images differ no more than by 4:2:0 color and near-lossless H.264."""
    spec = VideoSpec(frames=9, height=32, width=48, fps=8)
    frame, row, column = np.mgrid[:9, :32, :48]
    smooth = [
        np.stack([8 * frame + 3 * row, 4 * column, 60 * shift + row + column], axis=-1).astype(
            np.uint8
        )
        for shift in range(3)
    ]
    mask = np.zeros((9, 32, 48), np.uint8)
    mask[:, :, 30:] = 255
    triplets = [
        Triplet(
            video_id=f"clip_{number}",
            prompt="hands move, and more",
            prior=smooth[0],
            hands=smooth[2],
            mask=mask,
            first_frame=smooth[0][0],
            target=smooth[1 + number],
            extra={"split": "train"},
        )
        for number in (0, 1)
    ]
    metadata = write_clips(tmp_path / "clips", triplets, fps=8)
    items = read_metadata(metadata)
    for triplet, files in zip(triplets, items, strict=True):
        back = load_triplet(files, spec)
        assert (back.video_id, back.prompt) == (triplet.video_id, triplet.prompt)
        assert back.extra == {"split": "train"}
        np.testing.assert_array_equal(back.first_frame, triplet.first_frame)
        assert ((back.mask > 127) == (triplet.mask > 127)).mean() > 0.99
        for name in ("prior", "hands", "target"):
            gap = getattr(back, name).astype(float) - getattr(triplet, name)
            assert np.abs(gap).mean() < 6


def test_rows_that_processes_append_at_once_are_all_kept(tmp_path):
    program = """if True:
        import sys, numpy as np
        from pathlib import Path
        from egosim_jax.data import clips
        from egosim_jax.types import Triplet
        names = ("ego_prior_video", "hand_keypoint_video", "first_frame", "prompt")
        row = dict.fromkeys(names, "a")
        clips.write_clip = lambda folder, triplet, fps: {**row, "video_id": triplet.video_id}
        for number in range(20):
            video = np.zeros((1, 16, 16, 3), np.uint8)
            triplet = Triplet(
                video_id=f"{sys.argv[2]}_{number}", prompt="", prior=video, hands=video,
                mask=video[..., 0], first_frame=video[0],
            )
            clips.write_clips(Path(sys.argv[1]), [triplet], fps=8, append=True)
    """
    commands = [[sys.executable, "-c", program, str(tmp_path), name] for name in "ab"]
    running = [subprocess.Popen(command) for command in commands]
    assert [process.wait() for process in running] == [0, 0]
    ids = {row["video_id"] for _, row in csv_rows(tmp_path / "metadata.csv")}
    assert ids == {f"{name}_{number}" for name in "ab" for number in range(20)}


def cut_off(path):
    """Leave the first half of a video whose header comes first."""
    with av.open(io.BytesIO(path.read_bytes())) as old:
        path.unlink()
        with av.open(str(path), "w", options={"movflags": "faststart"}) as new:
            stream = new.add_stream_from_template(old.streams.video[0])
            for packet in old.demux(video=0):
                if packet.size:
                    packet.stream = stream
                    new.mux(packet)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])


def test_lenient_says_how_many_frames_of_a_cut_off_video_are_missing(files, caplog):
    cut_off(files.hands)
    triplet = load_triplet(files, NATIVE, policy="lenient")
    have = len(read_video(files.hands, damage="stop").frames)
    assert 0 < have < 9
    np.testing.assert_array_equal(triplet.hands[have], triplet.hands[-1])
    assert f"{9 - have} of 9 frames are missing in {files.hands}" in caplog.text


def test_damage_behind_the_first_frame_is_refused_by_row(files):
    data = bytearray(files.hands.read_bytes())
    end = data.index(b"moov") - 4
    data[end - 60 : end] = bytes(60)
    files.hands.write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"metadata\.csv line 2 \(clip0\).*damaged"):
        load_triplet(files, NATIVE)


def test_a_clip_may_be_larger_than_memory_should_hold(files, monkeypatch):
    whole = load_triplet(files, dataclasses.replace(NATIVE, height=16, width=16))
    monkeypatch.setattr("egosim_jax.io.video.MAX_KEPT", 9 * 16 * 16 * 3)
    again = load_triplet(files, dataclasses.replace(NATIVE, height=16, width=16))
    np.testing.assert_array_equal(again.prior, whole.prior)


def test_the_decoding_can_be_chosen(files):
    official = load_triplet(files, NATIVE, decoding="official")
    expected = read_video(files.prior, decoding="official").frames
    np.testing.assert_array_equal(official.prior, expected)


@pytest.mark.parametrize("name", ["prior", "first_frame"])
def test_a_pipe_or_a_name_with_nul_is_a_problem_of_its_clip(files, name):
    pipe = files.prior.parent / "pipe.mp4"
    os.mkfifo(pipe)
    for path in (pipe, pipe.with_name("a\0.mp4")):
        (problem,) = check_clip(dataclasses.replace(files, **{name: path}), NATIVE)
        assert "not a regular file" in problem or "null" in problem


@pytest.mark.parametrize(
    ("fps", "rule"), [(8, "first"), (30, "first"), (16.5, "first"), (8, "rate")]
)
def test_clips_of_another_rate_are_refused(files, tmp_path, fps, rule):
    with pytest.raises(InputError, match=f"{fps:g} frames a second are not the model's 16"):
        load_triplet(at_rate(files, tmp_path, Fraction(fps)), NATIVE, resampling=rule)


def at_rate(files, folder, fps):
    """Return a clip whose videos have the same frames at another rate."""
    changed = {}
    for name in ("prior", "hands", "target", "mask"):
        frames = read_video(getattr(files, name)).frames
        changed[name] = folder / f"{name}.mp4"
        write_video(changed[name], frames, fps)
    return dataclasses.replace(files, **changed)


def test_a_prior_of_another_kind_than_the_models_is_refused():
    assert prior_column("static") == {}
    assert prior_problem({}, "predicted") is None
    assert prior_problem(prior_column("predicted"), "predicted") is None
    assert "--prior static" in prior_problem(prior_column("predicted"), "static")
