"""Videos and images in and out, and what is refused."""

from fractions import Fraction

import av
import numpy as np
import pytest
from PIL import Image

from egosim_jax.io import video as video_io
from egosim_jax.io.video import (
    decode_video,
    encode_video,
    probe_video,
    read_image,
    read_video,
    write_video,
)
from egosim_jax.types import InputError

# 4:2:0 halves the colour resolution, so only smooth colours come back; x264 at crf 10 and the
# rounding to limited range (219 levels) then stay within this many grey levels.
LEVELS = 6


def smooth(frames=5, height=32, width=48):
    f, y, x = np.meshgrid(np.arange(frames), np.arange(height), np.arange(width), indexing="ij")
    return np.stack([40 + 3 * y + f, 60 + 2 * x, 200 - y - x], axis=-1).astype(np.uint8)


def test_a_written_video_reads_back(tmp_path):
    frames = smooth()
    write_video(tmp_path / "a.mp4", frames, 16)
    back = read_video(tmp_path / "a.mp4")
    assert back.fps == 16
    assert np.abs(back.frames.astype(int) - frames).max() <= LEVELS


def test_reading_and_writing_shift_no_colour_on_average():
    rng = np.random.default_rng(0)
    cells = rng.integers(30, 226, (5, 8, 8, 3)).astype(np.uint8)
    frames = cells.repeat(8, axis=1).repeat(8, axis=2)
    difference = decode_video(encode_video(frames, 16, crf=0)).frames.astype(float) - frames
    # Rounding 320 colours averages out to less than 0.3 levels; the scaler's default is off by 1.
    assert np.abs(difference.mean(axis=(0, 1, 2))).max() < 0.3


def test_the_written_file_is_tagged_h264_yuv420p_bt601(tmp_path):
    write_video(tmp_path / "a.mp4", smooth(), 16)
    with av.open(tmp_path / "a.mp4") as container:
        codec = container.streams.video[0].codec_context
        assert (codec.name, codec.pix_fmt) == ("h264", "yuv420p")
        assert (codec.colorspace, codec.color_range) == (6, 1)


def test_writing_leaves_no_temporary_file(tmp_path):
    write_video(tmp_path / "deep" / "a.mp4", smooth(), 16)
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.mp4"]


def test_a_fractional_rate_survives():
    assert decode_video(encode_video(smooth(), Fraction(30000, 1001))).fps == Fraction(30000, 1001)


def test_a_range_of_frames_is_that_part_of_the_video():
    data = encode_video(smooth(frames=9), 16)
    whole = decode_video(data).frames
    np.testing.assert_array_equal(decode_video(data, start=2, stop=6).frames, whole[2:6])


def test_a_video_that_ends_early_gives_the_frames_it_has():
    assert len(decode_video(encode_video(smooth(frames=5), 16), start=3, stop=9).frames) == 2


def test_probing_counts_frames_without_decoding(tmp_path):
    write_video(tmp_path / "a.mp4", smooth(frames=9), 16)
    info = probe_video(tmp_path / "a.mp4")
    assert (info.frames, info.height, info.width, info.fps) == (9, 32, 48, 16)


@pytest.mark.parametrize("reader", [read_video, probe_video])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "There is no file"),
        (b"", "is empty"),
        (b"not a video" * 99, "is not a readable video"),
        # A playlist must not make the reader open what it names.
        (b"#EXTM3U\n#EXTINF:1,\n/etc/hostname\n", "is not a readable video"),
    ],
)
def test_a_bad_file_is_refused_by_name(tmp_path, reader, content, message):
    path = tmp_path / "bad.mp4"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        reader(path)
    assert str(path) in str(caught.value)


def test_a_truncated_file_is_refused(tmp_path):
    data = encode_video(smooth(), 16)
    (tmp_path / "half.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="is not a readable video"):
        read_video(tmp_path / "half.mp4")


def test_a_range_beyond_the_end_is_refused():
    with pytest.raises(InputError, match="no frames from frame 7 on"):
        decode_video(encode_video(smooth(frames=5), 16), start=7)


def test_too_many_frames_are_refused():
    with pytest.raises(InputError, match="longer than 4 frames"):
        decode_video(encode_video(smooth(frames=5), 16), max_frames=4)


def test_too_many_pixels_are_refused(monkeypatch):
    monkeypatch.setattr(video_io, "MAX_PIXELS", 5 * 32 * 48 - 1)
    with pytest.raises(InputError, match="pixels"):
        decode_video(encode_video(smooth(frames=5), 16))


@pytest.mark.parametrize("shape", [(0, 32, 48, 3), (5, 31, 48, 3), (5, 32, 47, 3)])
def test_what_420_cannot_hold_is_not_written(shape):
    with pytest.raises(InputError, match="even width and height"):
        encode_video(np.zeros(shape, np.uint8), 16)


def test_an_image_with_transparency_reads_as_rgb(tmp_path):
    Image.new("RGBA", (6, 4), (10, 20, 30, 128)).save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png")
    assert image.shape == (4, 6, 3)
    assert (image == (10, 20, 30)).all()


def test_an_unreadable_image_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"a\.png is not a readable image"):
        read_image(tmp_path / "a.png")


def test_a_truncated_image_is_refused(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    Image.fromarray(noise).save(tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="is not a readable image"):
        read_image(tmp_path / "a.png")


def test_an_image_above_the_cap_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(video_io, "MAX_IMAGE_PIXELS", 6 * 4 - 1)
    Image.new("RGB", (6, 4)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="6x4 pixels"):
        read_image(tmp_path / "a.png")
