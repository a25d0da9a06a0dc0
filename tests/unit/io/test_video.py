"""Videos are written and read; damaged and hostile ones are refused."""

import io
import os
import struct
import tempfile
from fractions import Fraction

import av
import numpy as np
import pytest
from PIL import Image

from egosim_jax.io import decoding, video
from egosim_jax.io.containers import check_boxes
from egosim_jax.io.decoding import DamagedError
from egosim_jax.io.images import read_image
from egosim_jax.io.video import probe_video, read_video
from egosim_jax.io.writing import encode_video, write_frames, write_video
from egosim_jax.types import InputError
from tests.captures import encode

# 4:2:0 halves the color resolution, so it preserves only smooth colors; x264 at crf 10 and the
# rounding to limited range (219 levels) then stay within this many gray levels.
LEVELS = 6


def smooth(frames=5, height=32, width=48):
    f, y, x = np.meshgrid(np.arange(frames), np.arange(height), np.arange(width), indexing="ij")
    return np.stack([40 + 3 * y + f, 60 + 2 * x, 200 - y - x], axis=-1).astype(np.uint8)


def test_a_written_video_reads_back(tmp_path):
    frames = smooth()
    write_video(str(tmp_path / "a.mp4"), frames, 16)
    back = read_video(tmp_path / "a.mp4")
    assert back.fps == 16
    assert np.abs(back.frames.astype(int) - frames).max() <= LEVELS


def test_frames_of_floats_are_refused_with_the_conversion(tmp_path):
    with pytest.raises(InputError, match=r"float64 .* uint8, from 0 to 255"):
        write_frames(tmp_path / "a.mp4", smooth() / 255, 16)
    assert not any(tmp_path.iterdir())


def test_reading_and_writing_shift_no_color_on_average():
    rng = np.random.default_rng(0)
    cells = rng.integers(30, 226, (5, 8, 8, 3)).astype(np.uint8)
    frames = cells.repeat(8, axis=1).repeat(8, axis=2)
    difference = read_video(encode_video(frames, 16, crf=0)).frames.astype(float) - frames
    # Rounding 320 colors averages out to less than 0.3 levels; the scaler's default is off by 1.
    assert np.abs(difference.mean(axis=(0, 1, 2))).max() < 0.3


def test_writing_leaves_no_temporary_file(tmp_path):
    write_video(tmp_path / "deep" / "a.mp4", smooth(), 16)
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.mp4"]


def test_a_fractional_rate_survives():
    assert read_video(encode_video(smooth(), Fraction(30000, 1001))).fps == Fraction(30000, 1001)


def as_gif():
    file = io.BytesIO()
    first, *others = map(Image.fromarray, smooth())
    first.save(file, "GIF", save_all=True, append_images=others)
    return file.getvalue()


REFUSED = {
    "missing": (None, "No such file"),
    "empty": (b"", "is empty"),
    "text": (b"not a video" * 99, "is not a readable video"),
    # A playlist must not make the reader open what it names.
    "playlist": (b"#EXTM3U\n#EXTINF:1,\n/etc/hostname\n", "is not a readable video"),
    "no header": (encode_video(smooth(), 16)[:-1300], "is not a readable video"),
    "zeros": (bytes(5000), "is not a readable video"),
    "GIF": (as_gif(), r"not a readable video.*MP4, MOV, Matroska.*`ffmpeg -i IN"),
}


@pytest.mark.parametrize("reader", [read_video, probe_video])
@pytest.mark.parametrize("kind", REFUSED)
def test_a_file_that_is_no_video_is_refused_by_name(kind, reader, tmp_path):
    path, (content, message) = tmp_path / "a.mp4", REFUSED[kind]
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        reader(path)
    assert str(path) in str(caught.value)


def test_an_invalid_packet_is_named_in_plain_words():
    data = bytearray(encode_video(detailed(), 16))
    begin = data.index(b"mdat") + 1800
    data[begin : begin + 500] = bytes(500)
    with pytest.raises(DamagedError, match=r"is damaged: [A-Za-z ]+\. Download or export"):
        read_video(bytes(data))


def test_a_range_beyond_the_end_is_refused():
    with pytest.raises(InputError, match=r"Frames 7 of .* it has 5, counted from 0"):
        read_video(encode_video(smooth(frames=5), 16), start=7)


@pytest.mark.parametrize(("limit", "value"), [("MAX_FRAMES", 4), ("MAX_PIXELS", 5 * 32 * 48 - 1)])
def test_one_call_decodes_a_bounded_part(monkeypatch, limit, value):
    monkeypatch.setattr(decoding, limit, value)
    data = encode_video(smooth(frames=5), 16)
    with pytest.raises(InputError, match="one call decodes at most"):
        read_video(data)
    assert probe_video(data).frames == 5
    assert len(read_video(data, stop=3).frames) == 3


@pytest.mark.parametrize("shape", [(0, 32, 48, 3), (5, 31, 48, 3), (5, 32, 47, 3)])
def test_what_420_cannot_hold_is_not_written(shape):
    with pytest.raises(InputError, match="even width and height"):
        encode_video(np.zeros(shape, np.uint8), 16)


def detailed(frames=9):
    """Noise on a gradient: enough bytes of H.264 for damage to show."""
    noise = np.random.default_rng(0).integers(0, 30, (frames, 32, 48, 3)).astype(np.uint8)
    return smooth(frames) + noise


def remuxed(data):
    """The same packets in a new file whose header comes first."""
    with tempfile.NamedTemporaryFile(suffix=".mp4") as file:
        options = {"movflags": "faststart"}
        with av.open(io.BytesIO(data)) as old, av.open(file.name, "w", options=options) as new:
            stream = new.add_stream_from_template(old.streams.video[0])
            for packet in old.demux(video=0):
                if packet.size:
                    packet.stream = stream
                    new.mux(packet)
        return file.read()


def flipped(data, at):
    return data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :]


def test_a_bit_that_breaks_the_stream_is_refused_in_most_places():
    """H.264 has no checksum; at b291cad only damage to the boxes was refused."""
    data = encode_video(detailed(), 16)
    whole = read_video(data).frames
    begin = data.index(b"mdat") + 800  # behind x264's description of itself
    wrong = refused = 0
    for at in range(begin, begin + 6000, 60):
        try:
            wrong += not np.array_equal(read_video(flipped(data, at)).frames, whole)
        except InputError:
            refused += 1
    assert refused > 20, f"{refused} refused, {wrong} not seen"


def test_a_frame_marked_as_corrupt_is_refused(monkeypatch):
    data = encode_video(detailed(), 16)
    options = {**decoding._OPTIONS, "err_detect": "0"}
    monkeypatch.setattr(decoding, "_OPTIONS", options)  # so that FFmpeg conceals what it can
    begin = data.index(b"mdat") + 800
    messages = []
    for at in range(begin, begin + 3000, 30):
        try:
            read_video(flipped(data, at))
        except InputError as error:
            messages.append(str(error))
    assert any("is corrupt" in message for message in messages)


def test_a_packet_without_a_frame_is_refused():
    data = bytearray(encode_video(detailed(), 16))
    (count,) = struct.unpack_from(">I", data, data.index(b"stsz") + 12)
    sizes = struct.unpack_from(f">{count}I", data, data.index(b"stsz") + 16)
    third = data.index(b"mdat") + 4 + sum(sizes[:5])
    data[third + 4] = 0x0C  # a filler instead of a frame
    with pytest.raises(InputError, match="damaged"):
        read_video(bytes(data))


def test_frames_outside_the_edit_list_are_not_counted():
    """Probing counted them, decoding dropped them, and the last frame was repeated for them."""
    data = bytearray(encode_video(smooth(9), 16))
    edit = data.index(b"elst") + 12
    duration, start = struct.unpack_from(">II", data, edit)
    struct.pack_into(">II", data, edit, duration // 9 * 5, start)
    assert probe_video(bytes(data)).frames == len(read_video(bytes(data)).frames) == 5


@pytest.fixture
def half(tmp_path):
    """The first half of a video whose header comes first."""
    data = remuxed(encode_video(detailed(), 16))
    (tmp_path / "half.mp4").write_bytes(data[: len(data) // 2])
    return tmp_path / "half.mp4"


@pytest.mark.parametrize("reader", [read_video, probe_video])
def test_a_video_cut_off_behind_its_header_is_refused(half, reader):
    with pytest.raises(InputError, match=r"is cut off"):
        reader(half)


def test_what_is_left_of_a_damaged_video_is_given_if_asked_for(half):
    frames = read_video(half, damage="stop").frames
    assert 0 < len(frames) < 9
    assert probe_video(half, damage="stop").frames == len(frames)
    whole = read_video(encode_video(detailed(), 16)).frames
    np.testing.assert_array_equal(frames, whole[: len(frames)])


@pytest.mark.parametrize("reader", [read_video, probe_video, read_image])
def test_a_pipe_and_a_name_with_nul_are_refused(tmp_path, reader):
    os.mkfifo(tmp_path / "pipe")
    for name, message in (("pipe", "not a regular file"), ("a\0.mp4", "null")):
        with pytest.raises(InputError, match=message):
            reader(tmp_path / name)


@pytest.mark.parametrize("reader", [read_video, probe_video])
def test_an_unknown_codec_is_refused(reader):
    data = encode_video(smooth(), 16).replace(b"avc1", b"zzz9").replace(b"avcC", b"zzzC")
    with pytest.raises(InputError, match=r"codec|readable|damaged"):
        reader(data)


def test_a_table_of_fifty_million_samples_is_refused_before_it_is_built():
    data = bytearray(encode_video(smooth(), 16))
    samples = 50_000_000
    struct.pack_into(">II", data, data.index(b"stsz") + 8, 1, samples)
    struct.pack_into(">I", data, data.index(b"stsc") + 16, samples)
    struct.pack_into(">I", data, data.index(b"stts") + 12, samples)
    with pytest.raises(InputError, match="samples"):
        read_video(bytes(data))


def test_frames_beyond_what_memory_should_hold_are_refused(monkeypatch):
    monkeypatch.setattr(video, "MAX_KEPT", 4 * 32 * 48 * 3)
    with pytest.raises(InputError, match="the maximum of one call"):
        read_video(encode_video(smooth(5), 16))
    smaller = read_video(encode_video(smooth(5), 16), each=lambda frame: frame[::2, ::2])
    assert smaller.frames.shape == (5, 16, 24, 3)


def test_official_decoding_is_the_scalers_default():
    """Equal, bit for bit, to `ffmpeg -pix_fmt rgb24`, which imageio calls."""
    data = encode_video(detailed(), 16)
    with av.open(io.BytesIO(data)) as container:
        expected = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    official = read_video(data, decoding="official").frames
    np.testing.assert_array_equal(official, expected)
    accurate = read_video(data).frames
    assert 0.3 < (accurate.astype(float) - official).mean() < 2


def test_the_groups_of_samples_of_a_phones_video_are_counted():
    """Its grouping type, four letters, is at the offset of other tables' entry count."""
    group = b"\0\0\0\0roll" + (1).to_bytes(4, "big") + (48_000).to_bytes(4, "big") + b"\0" * 4
    check_boxes(io.BytesIO((8 + len(group)).to_bytes(4, "big") + b"sbgp" + group), "a.mp4")
    many = group[:8] + (2**30).to_bytes(4, "big") + group[12:]
    with pytest.raises(InputError, match="more than 4,194,304 samples"):
        check_boxes(io.BytesIO((8 + len(many)).to_bytes(4, "big") + b"sbgp" + many), "a.mp4")


@pytest.mark.parametrize(
    ("level", "slicecrc", "slices"), [(3, 1, 4), (3, 1, 16), (3, 0, 4), (1, 0, 1)]
)
def test_a_damaged_slice_of_ffv1_is_refused_by_its_checksum(tmp_path, level, slicecrc, slices):
    options = {"level": str(level)}
    if level == 3:
        options |= {"slicecrc": str(slicecrc), "slices": str(slices)}
    data = encode(tmp_path / "whole.mkv", detailed(), codec="ffv1", options=options).read_bytes()
    assert len(read_video(data).frames) == 9
    with av.open(io.BytesIO(data)) as container:
        third = bytes([*container.demux(video=0)][2])
    for at in (40, len(third) // 2, len(third) - 200):
        where = data.index(third) + at
        damaged = data[:where] + bytes(100) + data[where + 100 :]
        if slicecrc:
            (tmp_path / "damaged.mkv").write_bytes(damaged)
            for reader in (read_video, probe_video):
                with pytest.raises(InputError, match="checksum"):
                    reader(tmp_path / "damaged.mkv")
