"""Clips are read at a model's length and size, strictly or as the EgoSim release does."""

import dataclasses
import io
import os
import subprocess
import sys

import av
import numpy as np
import pytest
from PIL import Image

from egosim_jax.data.clips import check_clip, load_triplet, write_clips
from egosim_jax.data.metadata import csv_rows, read_metadata
from egosim_jax.io.images import read_image
from egosim_jax.io.video import read_video, write_video
from egosim_jax.types import InputError, Triplet, VideoSpec

NATIVE = VideoSpec(frames=9, height=32, width=48)


@pytest.fixture
def files(clips):
    return read_metadata(clips)[0]


def shorten(path, frames):
    write_video(path, read_video(path).frames[:frames], 16)


def shrink(path, height, width):
    write_video(path, read_video(path).frames[:, :height, :width], 16)


def test_a_clip_of_the_models_size_passes_unchanged(files):
    triplet = load_triplet(files, NATIVE)
    np.testing.assert_array_equal(triplet.prior, read_video(files.prior).frames)
    np.testing.assert_array_equal(triplet.hands, read_video(files.hands).frames)
    np.testing.assert_array_equal(triplet.target, read_video(files.target).frames)
    np.testing.assert_array_equal(triplet.mask, read_video(files.mask).frames[..., 0])
    np.testing.assert_array_equal(triplet.first_frame, read_image(files.first_frame))


def test_id_prompt_and_further_columns_come_from_the_metadata(files):
    triplet = load_triplet(files, NATIVE)
    assert (triplet.video_id, triplet.prompt) == ("clip0", "hands move, clip 0")
    assert triplet.extra == {"split": "train"}


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


def test_a_longer_clip_gives_the_window_at_start(files):
    triplet = load_triplet(files, dataclasses.replace(NATIVE, frames=5), start=3)
    np.testing.assert_array_equal(triplet.hands, read_video(files.hands).frames[3:8])


def test_the_image_is_the_clips_own_wherever_the_window_begins(files):
    triplet = load_triplet(files, dataclasses.replace(NATIVE, frames=5), start=3)
    np.testing.assert_array_equal(triplet.first_frame, read_image(files.first_frame))


def test_the_first_frame_may_be_a_video(files):
    files = dataclasses.replace(files, first_frame=files.target)
    np.testing.assert_array_equal(
        load_triplet(files, NATIVE).first_frame, read_video(files.target).frames[0]
    )


def test_a_clip_without_truth_has_none(files):
    assert load_triplet(dataclasses.replace(files, target=None), NATIVE).target is None


def test_a_valid_clip_has_no_problems(files):
    assert check_clip(files, NATIVE) == []


@pytest.mark.parametrize("name", ["prior", "hands", "mask", "first_frame", "target"])
def test_strict_refuses_a_missing_file_by_row_and_path(files, name):
    path = getattr(files, name)
    path.unlink()
    assert check_clip(files, NATIVE) == [
        f"metadata.csv line 2 (clip0): {path} cannot be read: No such file or directory."
    ]


def test_every_missing_file_is_listed(files):
    files.prior.unlink()
    files.hands.unlink()
    assert len(check_clip(files, NATIVE)) == 2


def test_strict_refuses_frame_counts_that_disagree(files):
    shorten(files.hands, 5)
    with pytest.raises(InputError, match="disagree: prior 9, hands 5, mask 9, target 9") as caught:
        load_triplet(files, NATIVE)
    assert "(egosim generate --lenient repeats or cuts)" in str(caught.value)


def test_strict_refuses_a_count_that_is_not_4k_plus_1(make_clips):
    (files,) = read_metadata(make_clips(clips=1, frames=10))
    with pytest.raises(InputError, match=r"10 frames cannot be encoded.*Nearest: 9 or 13"):
        load_triplet(files, NATIVE)


def test_strict_refuses_a_clip_shorter_than_the_window(files):
    with pytest.raises(InputError, match="9 frames are fewer than the 12"):
        load_triplet(files, NATIVE, start=3)


def test_strict_refuses_sizes_that_disagree(files):
    shrink(files.hands, 16, 48)
    with pytest.raises(InputError, match="disagree: prior 48x32, hands 48x16"):
        load_triplet(files, NATIVE)


def test_strict_refuses_sizes_that_are_not_multiples_of_16(make_clips):
    (files,) = read_metadata(make_clips(clips=1, height=24))
    with pytest.raises(InputError, match="48x24 pixels: width and height must be multiples of 16"):
        load_triplet(files, NATIVE)


def test_strict_refuses_an_unreadable_video(files):
    files.prior.write_bytes(b"no video")
    with pytest.raises(InputError, match=r"ego_prior_video\.mp4 is not a readable video"):
        load_triplet(files, NATIVE)


def test_lenient_repeats_the_last_frame(files):
    shorten(files.hands, 6)
    hands = load_triplet(files, NATIVE, policy="lenient").hands
    have = read_video(files.hands).frames
    np.testing.assert_array_equal(hands, have[[0, 1, 2, 3, 4, 5, 5, 5, 5]])


def test_lenient_cuts(files):
    shorten(files.prior, 6)
    triplet = load_triplet(files, dataclasses.replace(NATIVE, frames=5), policy="lenient")
    np.testing.assert_array_equal(triplet.prior, read_video(files.prior).frames[:5])


def test_lenient_resizes_each_video(files):
    shrink(files.hands, 16, 32)
    hands = load_triplet(files, NATIVE, policy="lenient").hands
    frame = Image.fromarray(read_video(files.hands).frames[0])
    expected = frame.resize((48, 32), Image.Resampling.LANCZOS)
    np.testing.assert_array_equal(hands[0], np.asarray(expected))


def test_lenient_takes_a_missing_mask_for_all_observed(files):
    files.mask.unlink()
    mask = load_triplet(files, NATIVE, policy="lenient").mask
    assert mask.shape == (9, 32, 48)
    assert not mask.any()


def test_lenient_does_without_a_missing_truth(files):
    files.target.unlink()
    assert load_triplet(files, NATIVE, policy="lenient").target is None


def test_lenient_still_refuses_a_missing_prior(files):
    files.prior.unlink()
    with pytest.raises(InputError, match="No such file"):
        load_triplet(files, NATIVE, policy="lenient")


def test_clips_that_were_written_are_read_back(tmp_path):
    """Return True if smooth images differ no more than by 4:2:0 color and near-lossless H.264."""
    spec = VideoSpec(frames=9, height=32, width=48)
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


def test_strict_refuses_a_video_that_was_cut_off(files):
    cut_off(files.hands)
    (problem,) = check_clip(files, NATIVE)
    assert "metadata.csv line 2 (clip0)" in problem
    assert "is cut off" in problem


def test_lenient_says_how_many_frames_of_a_cut_off_video_are_missing(files, caplog):
    cut_off(files.hands)
    triplet = load_triplet(files, NATIVE, policy="lenient")
    have = len(read_video(files.hands, damage="stop").frames)
    assert 0 < have < 9
    np.testing.assert_array_equal(triplet.hands[have], triplet.hands[-1])
    assert f"{9 - have} of 9 frames are missing in {files.hands}" in caplog.text


def test_lenient_says_how_many_frames_a_short_video_lacks(files, caplog):
    shorten(files.prior, 5)
    load_triplet(files, NATIVE, policy="lenient")
    assert f"4 of 9 frames are missing in {files.prior}" in caplog.text


def test_damage_behind_the_first_frame_is_refused_by_row(files):
    data = bytearray(files.hands.read_bytes())
    end = data.index(b"moov") - 4
    data[end - 60 : end] = bytes(60)
    files.hands.write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"metadata\.csv line 2 \(clip0\).*damaged"):
        load_triplet(files, NATIVE)


def test_a_clip_may_be_larger_than_memory_should_hold(files, monkeypatch):
    whole = load_triplet(files, dataclasses.replace(NATIVE, height=16, width=16))
    monkeypatch.setattr("egosim_jax.io.decoding.MAX_KEPT", 9 * 16 * 16 * 3)
    again = load_triplet(files, dataclasses.replace(NATIVE, height=16, width=16))
    np.testing.assert_array_equal(again.prior, whole.prior)


def test_official_decoding_is_darker(files):
    accurate = load_triplet(files, NATIVE)
    official = load_triplet(files, NATIVE, decoding="official")
    np.testing.assert_array_equal(
        official.prior, read_video(files.prior, decoding="official").frames
    )
    assert (accurate.prior.astype(float) - official.prior).mean() > 0.2


@pytest.mark.parametrize("name", ["prior", "first_frame"])
def test_a_pipe_or_a_name_with_nul_is_a_problem_of_its_clip(files, name):
    pipe = files.prior.parent / "pipe.mp4"
    os.mkfifo(pipe)
    for path in (pipe, pipe.with_name("a\0.mp4")):
        (problem,) = check_clip(dataclasses.replace(files, **{name: path}), NATIVE)
        assert "not a regular file" in problem or "null" in problem
