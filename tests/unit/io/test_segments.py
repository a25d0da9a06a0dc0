"""Segments of videos: the same frames as decoding everything, for any codec and frame order."""

from fractions import Fraction

import av
import numpy as np
import pytest

from egosim_jax.io.segments import probe_long_video, read_segment
from egosim_jax.io.video import read_video
from egosim_jax.types import InputError

CODECS = {
    "libx264": {"g": "7", "bf": "3", "x264-params": "open-gop=1"},
    "libsvtav1": {"preset": "12", "g": "8", "svtav1-params": "scm=0"},
}


def write(path, *, codec="libx264", count=40, options=None, times=None):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        stream.options = options or CODECS[codec]
        stream.codec_context.time_base = Fraction(1, 600)
        for index in range(count):
            frame = np.full((64, 64, 3), 3 * index, np.uint8)
            frame[:, : index + 1] = 255 - 3 * index
            coded = av.VideoFrame.from_ndarray(frame, format="rgb24")
            coded.pts = 20 * index if times is None else times[index]
            coded.time_base = Fraction(1, 600)
            container.mux(stream.encode(coded))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize("codec", CODECS)
def test_a_segment_has_the_frames_of_the_whole_video(tmp_path, codec):
    path = write(tmp_path / "video.mp4", codec=codec)
    every = read_video(path).frames
    for start, count in ((0, 40), (5, 3), (6, 2), (7, 9), (13, 1), (39, 1)):
        segment = read_segment(path, start=start, count=count).frames
        np.testing.assert_array_equal(segment, every[start : start + count])


def test_frames_are_counted_where_the_rate_varies(tmp_path):
    times = np.cumsum([20 + 15 * (index % 4 == 0) for index in range(40)]).tolist()
    path = write(tmp_path / "video.mp4", times=times)
    np.testing.assert_array_equal(
        read_segment(path, start=20, count=4).frames, read_video(path).frames[20:24]
    )


def test_a_pause_is_refused_with_the_command_that_converts(tmp_path):
    assert probe_long_video(write(tmp_path / "even.mp4")).fps == 30
    times = [20 * index + (300 if index >= 20 else 0) for index in range(40)]  # a pause of 0.5 s
    path = write(tmp_path / "pause.mp4", times=times)
    with pytest.raises(
        InputError, match=r"variable frame rate: .*0\.63 and 1\.17 s.*-vf fps=30 OUT"
    ):
        probe_long_video(path)
    with pytest.raises(InputError, match="variable frame rate"):
        read_segment(path, start=24, count=2)
    assert len(read_segment(path, start=0, count=20).frames) == 20


def test_a_video_longer_than_what_is_decoded_at_once_is_probed_and_read(tmp_path, monkeypatch):
    path = write(tmp_path / "video.mp4")
    monkeypatch.setattr("egosim_jax.io.decoding.MAX_PIXELS", 20 * 64 * 64)
    with pytest.raises(InputError, match="pixels"):
        read_video(path)
    assert probe_long_video(path).frames == 40
    assert len(read_segment(path, start=30, count=8).frames) == 8


def test_frames_beyond_the_end_are_refused(tmp_path):
    path = write(tmp_path / "video.mp4")
    with pytest.raises(InputError, match="it has 40"):
        read_segment(path, start=35, count=6)


def test_a_truncated_video_is_refused(tmp_path):
    path = write(tmp_path / "video.mkv")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError):
        read_segment(path, start=30, count=5)
    path.write_bytes(data[:40])
    with pytest.raises(InputError):
        probe_long_video(path)
