"""Ranges of videos: the same frames as decoding everything, for any codec and frame order."""

from fractions import Fraction

import av
import numpy as np
import pytest

from egosim_jax.io.video import probe_video, read_moments, read_video
from egosim_jax.types import InputError

CODECS = {
    "libx264": {"g": "7", "bf": "3", "x264-params": "open-gop=1"},
    "libsvtav1": {"preset": "12", "g": "8", "svtav1-params": "scm=0"},
}


def write(path, *, codec="libx264", count=40, options=None, times=None, size=64):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = size, size, "yuv420p"
        stream.options = options or CODECS[codec]
        stream.codec_context.time_base = Fraction(1, 600)
        for index in range(count):
            frame = np.full((size, size, 3), 3 * index, np.uint8)
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
        segment = read_video(path, start=start, stop=start + count).frames
        np.testing.assert_array_equal(segment, every[start : start + count])


def test_frames_are_counted_where_the_rate_varies(tmp_path):
    times = np.cumsum([20 + 15 * (index % 4 == 0) for index in range(40)]).tolist()
    path = write(tmp_path / "video.mp4", times=times)
    np.testing.assert_array_equal(
        read_video(path, start=20, stop=24).frames, read_video(path).frames[20:24]
    )


def test_a_pause_is_refused_with_the_command_that_converts(tmp_path):
    assert probe_video(write(tmp_path / "even.mp4")).fps == 30
    times = [20 * index + (300 if index >= 20 else 0) for index in range(40)]  # a pause of 0.5 s
    path = write(tmp_path / "pause.mp4", times=times)
    with pytest.raises(
        InputError, match=r"variable frame rate: .*0\.63 and 1\.17 s.*-vf fps=30 OUT"
    ):
        probe_video(path)
    with pytest.raises(InputError, match="variable frame rate"):
        read_video(path, start=24, stop=26)
    assert len(read_video(path, start=0, stop=20).frames) == 20


def test_frames_beyond_the_end_are_refused(tmp_path):
    path = write(tmp_path / "video.mp4")
    with pytest.raises(InputError, match="it has 40"):
        read_video(path, start=35, stop=41, whole=True)


@pytest.mark.parametrize(("suffix", "codec"), [("mkv", "libx264"), ("webm", "libsvtav1")])
def test_a_file_without_an_index_that_is_cut_off_is_refused_by_the_length_in_its_header(
    tmp_path, suffix, codec
):
    path = write(tmp_path / f"video.{suffix}", codec=codec)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    for read in (probe_video, read_video):
        with pytest.raises(InputError, match=r"cut off at 0\.\d s: its header says 1\.3 s"):
            read(path)
    assert 5 < len(read_video(path, damage="stop").frames) < 35
    path.write_bytes(data[:40])
    with pytest.raises(InputError):
        probe_video(path)


READS = [
    probe_video,
    read_video,
    lambda path: read_video(path, start=70, stop=80, whole=True),
    lambda path: read_moments(path, np.array([0.0, 0.1])),
]


@pytest.mark.parametrize("read", READS)
@pytest.mark.parametrize("behind", [0.4, 0.9])
def test_a_clock_that_begins_again_is_refused_by_every_reader(tmp_path, read, behind):
    """As when captures whose clocks overlap are joined (`cat a.ts b.ts`)."""
    first, second = (write(tmp_path / f"{name}.ts") for name in "ab")
    with av.open(str(second)) as source, av.open(str(tmp_path / "c.ts"), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                packet.pts, packet.dts = (
                    t + int(behind * 90_000) for t in (packet.pts, packet.dts)
                )
                packet.stream = stream
                target.mux(packet)
    (tmp_path / "joined.ts").write_bytes(first.read_bytes() + (tmp_path / "c.ts").read_bytes())
    with pytest.raises(InputError, match=r"the clock of the file begins again.*-vf setpts="):
        read(tmp_path / "joined.ts")


def test_a_change_of_size_is_named_with_the_command_that_scales(tmp_path):
    parts = [write(tmp_path / f"{size}.ts", size=size) for size in (64, 96)]
    joined = tmp_path / "joined.ts"
    with av.open(str(joined), "w") as target:
        stream, shift = None, 0
        for path in parts:
            with av.open(str(path)) as source:
                stream = stream or target.add_stream_from_template(source.streams.video[0])
                for packet in source.demux(video=0):
                    if packet.size:
                        packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                        packet.stream = stream
                        target.mux(packet)
            shift = 40 * 3000
    with pytest.raises(InputError, match=r"from 64x64 to 96x96 at .*-vf scale=64:64 OUT"):
        read_video(joined)
    assert read_video(joined, stop=30).frames.shape == (30, 64, 64, 3)
