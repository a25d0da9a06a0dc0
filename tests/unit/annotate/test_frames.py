"""Rate, size and length of clips."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.annotate.frames import Sampling, plan, read_frames, read_searched_frames
from egosim_jax.data.recording import Recording
from egosim_jax.geometry import project
from egosim_jax.types import InputError
from tests.unit.annotate.stubs import textured_video, write

FULL_HD = Recording(
    recording_id="a", video=Path("a.mp4"), frames=278, fps=Fraction(30), height=1080, width=1920
)


def recorded(folder, frames, fps=16):
    """Write a video and return its recording."""
    count, height, width, _ = frames.shape
    path = write(folder / "a.mp4", frames, fps)
    return replace(FULL_HD, video=path, frames=count, fps=Fraction(fps), height=height, width=width)


def test_the_size_of_a_video_is_kept_up_to_832_pixels():
    fitted = plan(FULL_HD, Sampling(), cut=False)
    assert (fitted.height, fitted.width, fitted.fps, fitted.count) == (464, 832, 30, 278)
    assert plan(replace(FULL_HD, height=96, width=160), Sampling(), cut=False).scale == 1


def test_portrait_keeps_its_shape_and_is_not_cropped_to_landscape():
    portrait = replace(FULL_HD, height=1920, width=1080)
    fitted = plan(portrait, Sampling(), cut=False)
    assert (fitted.height, fitted.width) == (832, 464)
    with pytest.raises(InputError, match=r"would keep 3\d% of the image.*--size"):
        plan(portrait, Sampling(size=(480, 832)), cut=False)


def test_fast_videos_are_thinned_to_sixty_frames_per_second():
    fitted = plan(replace(FULL_HD, fps=Fraction(120)), Sampling(), cut=False)
    assert fitted.fps == 60
    assert fitted.indices(0, 4).tolist() == [0, 2, 4, 6]


def test_another_rate_takes_egosims_frames():
    fitted = plan(FULL_HD, Sampling(fps=16.0), cut=False)
    assert fitted.indices(0, 61).tolist() == [(30 * k + 8) // 16 for k in range(61)]


def test_short_and_long_videos_are_refused():
    with pytest.raises(InputError, match="8 frames at 30 fps: a clip needs 9"):
        plan(replace(FULL_HD, frames=8), Sampling(), cut=False)
    two_seconds = replace(FULL_HD, frames=60)
    assert plan(two_seconds, Sampling(), cut=False).count == 60
    with pytest.raises(InputError, match="60 frames at 30 fps: a clip needs 61"):
        plan(two_seconds, Sampling(num_frames=61), cut=False)
    twenty_minutes = replace(FULL_HD, frames=36_000)
    with pytest.raises(InputError, match=r"36000 frames .* at most 601\. Cut it into clips"):
        plan(twenty_minutes, Sampling(), cut=False)
    assert plan(twenty_minutes, Sampling(num_frames=61), cut=True).count == 36_000


def test_sizes_and_lengths_fit_the_grid():
    with pytest.raises(InputError, match="must be a multiple of 16"):
        Sampling(size=(481, 832))
    with pytest.raises(InputError, match=r"4k\+1"):
        Sampling(num_frames=60)


def test_intrinsics_follow_resizing_and_cropping():
    fitted = plan(FULL_HD, Sampling(size=(480, 832)), cut=False)
    source = np.array([[1400.0, 0, 959.5], [0, 1400, 539.5], [0, 0, 1]])
    ray = np.array([[0.2, -0.1, 1.0]])
    u, v = (float(x[0]) for x in project(source, ray))
    expected = (
        (u + 0.5) * fitted.scale - 0.5 - fitted.offset_px[0],
        (v + 0.5) * fitted.scale - 0.5 - fitted.offset_px[1],
    )
    have = tuple(float(x[0]) for x in project(fitted.intrinsics(source), ray))
    assert have == pytest.approx(expected)


def test_frames_are_read_at_the_rate_of_the_clip(tmp_path):
    frames = np.repeat(np.arange(0, 250, 10, np.uint8), 48 * 80 * 3).reshape(25, 48, 80, 3)
    recording = recorded(tmp_path, frames, 24)
    fitted = plan(recording, Sampling(fps=8.0), cut=False)
    found = read_frames(recording, fitted, 0, fitted.count)
    assert np.abs(found.mean(axis=(1, 2, 3)) - np.arange(0, 250, 30)).max() < 3


def test_frames_are_cropped_in_the_middle(tmp_path):
    video = textured_video(9, 60, 90)
    recording = recorded(tmp_path, video)
    fitted = plan(recording, Sampling(), cut=False)
    assert (fitted.height, fitted.width) == (48, 80)
    assert fitted.scale == pytest.approx(80 / 90)
    assert read_frames(recording, fitted, 0, 9).shape == (9, 48, 80, 3)


@pytest.mark.parametrize("size", [(480, 832), (464, 832), (256, 448)])
def test_pixels_of_the_video_are_where_the_frame_is_resized_and_cropped(size):
    fitted = plan(replace(FULL_HD, height=1070), Sampling(size=size), cut=False)
    row, column = np.mgrid[:1070, :1920].astype(np.float32)
    clip = np.stack([fitted.fit(column), fitted.fit(row)], axis=-1)  # where each pixel is from
    there = fitted.pixels(clip.astype(float), (1070, 1920))
    row, column = np.mgrid[: size[0], : size[1]]
    inner = np.s_[2:-2, 2:-2]
    np.testing.assert_allclose(there[..., 0][inner], column[inner], atol=0.02)
    np.testing.assert_allclose(there[..., 1][inner], row[inner], atol=0.02)
    half = fitted.pixels((clip + 0.5) / 2 - 0.5, (535, 960))
    np.testing.assert_allclose(half, there, atol=1e-4)


def test_hands_are_searched_in_the_frames_of_the_video(tmp_path):
    video = textured_video(9, 60, 90)
    recording = recorded(tmp_path, video)
    smaller = plan(recording, Sampling(size=(32, 48)), cut=False)
    found = read_searched_frames(recording, np.array([1, 4]), smaller)
    assert found is not None
    assert found.shape == (2, 60, 90, 3)
    assert np.abs(found[1].astype(int) - video[4]).mean() < 5
    same = plan(replace(recording, height=48, width=80), Sampling(), cut=False)
    assert read_searched_frames(recording, np.array([1, 4]), same) is None
