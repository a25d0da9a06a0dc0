"""Colors keep their values and places from file to frame and back."""

from fractions import Fraction

import av
import numpy as np
import pytest
from av.filter import Graph

from egosim_jax.io.video import read_video
from egosim_jax.io.writing import encode_video, write_video


def edges(frame):
    """Columns where luma and redness of a square cross the middle between it and the ground."""
    row = frame[frame.shape[0] // 2].astype(float)
    found = []
    for values in (row @ [0.299, 0.587, 0.114], row[:, 0] - row[:, 1]):
        middle = (values[5] + values[len(values) // 2]) / 2
        above = (values > middle) != (values[5] > middle)
        for at in np.flatnonzero(np.diff(above)):
            found.append(at + (middle - values[at]) / (values[at + 1] - values[at]))
    assert len(found) == 4
    return np.array(found)


def tabletop():
    """Bodies of strong colors on a wooden table, with a shadow, that move a little."""
    y, x = np.meshgrid(np.arange(96), np.arange(160), indexing="ij")
    clip = []
    for time in range(5):
        grain = np.sin(0.3 * y + 0.05 * x)
        frame = np.stack([150 + 20 * grain, 110 + 8 * grain, 70 + 0 * grain], axis=-1)
        frame[30:40, 20 + time : 60 + time] *= 0.6
        frame[40:70, 20 + time : 50 + time] = (200, 40, 40)
        frame[np.hypot(y - 50, x - 100) < 18] = (40, 90, 200)
        frame[20:30, 120:150] = (235, 210, 60)
        clip.append(frame)
    return np.clip(clip, 0, 255).astype(np.uint8)


def psnr(frames, truth):
    return 10 * np.log10(255**2 / np.mean((frames.astype(float) - truth) ** 2))


@pytest.mark.parametrize("turned", [False, True], ids=["columns", "rows"])
def test_ten_trips_lose_little_and_move_no_edge(turned):
    square = np.full((5, 64, 96, 3), 128, np.uint8)
    square[:, 20:44, 32:64] = (220, 40, 40)
    table = tabletop()
    if turned:
        square, table = square.swapaxes(1, 2), table.swapaxes(1, 2)
    again, loss, found = {0: square, 1: table}, {}, []
    for trip in range(10):
        for key, truth in enumerate((square, table)):
            again[key] = read_video(encode_video(again[key], 8)).frames
            if trip in (0, 9):
                loss[key, trip] = psnr(again[key], truth)
        found.append(edges(again[0][2].swapaxes(0, 1) if turned else again[0][2]))
    for key in (0, 1):
        assert loss[key, 0] > 30
        assert loss[key, 9] > loss[key, 0] - 1.5, loss
    np.testing.assert_allclose(found[9], found[0], atol=0.05)
    np.testing.assert_allclose(found[9], [31.5, 63.5] * 2, atol=0.5)


@pytest.mark.parametrize("place", ["left", "center", "topleft"])
def test_chroma_is_read_where_the_file_has_it(tmp_path, place):
    frame = np.full((64, 96, 3), 128, np.uint8)
    frame[:, 32:64] = (220, 40, 40)
    number = ["left", "center", "topleft"].index(place)
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.options = {"crf": "0", "x264-params": f"chromaloc={number}"}
        graph = Graph()
        source = graph.add_buffer(
            width=96, height=64, format=av.VideoFormat("rgb24"), time_base=Fraction(1, 30)
        )
        scale = graph.add("scale", f"flags=bicubic+accurate_rnd:out_chroma_loc={place}")
        nodes = source, scale, graph.add("format", "yuv420p"), graph.add("buffersink")
        graph.link_nodes(*nodes).configure()
        for index in range(3):
            full = av.VideoFrame.from_ndarray(frame, format="rgb24")
            full.pts, full.time_base = index, Fraction(1, 30)
            graph.vpush(full)
            container.mux(stream.encode(graph.vpull()))
        container.mux(stream.encode())
    found = read_video(tmp_path / "a.mp4")
    np.testing.assert_allclose(edges(found.frames[0]), [31.5, 63.5] * 2, atol=0.25)


def test_a_written_file_states_its_colors(tmp_path):
    write_video(tmp_path / "a.mp4", tabletop(), 8)
    with av.open(str(tmp_path / "a.mp4")) as container:
        coder = container.streams.video[0].codec_context
        assert (coder.name, coder.pix_fmt) == ("h264", "yuv420p")
        stated = coder.colorspace, coder.color_range, coder.color_primaries, coder.color_trc
    assert stated == (6, 1, 1, 13)  # BT.601's matrix, limited range; BT.709's primaries, sRGB


def test_chroma_that_was_read_is_written_unchanged():
    """The filters are left inverses of the reader's; only rounding and the codec remain."""
    cells = np.random.default_rng(0).integers(60, 190, (1, 12, 16, 3)).astype(np.uint8)
    once = read_video(encode_video(cells.repeat(8, 1).repeat(8, 2), 8, crf=0)).frames
    twice = read_video(encode_video(once, 8, crf=0)).frames
    assert psnr(twice, once) > 45
