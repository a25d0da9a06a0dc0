"""Videos whose gray levels number their frames, with chosen time stamps."""

from fractions import Fraction
from typing import Any

import av
import numpy as np

HEIGHT, WIDTH, FRAMES, FPS = 96, 128, 24, 30
QUALITY = {
    "libx264": {"preset": "ultrafast", "crf": "8"},
    "mpeg2video": {"qmin": "1", "qmax": "2"},
}
TICK = Fraction(1, 3000)
PERIOD = 100  # ticks
EVEN = [PERIOD * k for k in range(FRAMES)]
PAUSED = [t + 1000 * (t >= 8 * PERIOD) for t in EVEN]


def gray(number):
    return 16 + 9 * (np.asarray(number) % FRAMES)


def numbers(frames):
    """The number of each frame, modulo `FRAMES`."""
    level = np.asarray(frames)[:, 24:72, 32:96].mean(axis=(1, 2, 3))
    return np.rint((level - 16) / 9).astype(int).tolist()


def write_film(path, stamps=EVEN, *, format="mp4", unit=TICK, codec="libx264", cut=0, last=None,
               rate=FPS, **options):  # fmt: skip
    """Write frames whose stamps are in `unit`; `cut` drops packets, `last` is the last duration."""
    path.parent.mkdir(parents=True, exist_ok=True)
    muxing = {"avoid_negative_ts": "disabled"}
    with av.open(str(path), "w", format=format, options=muxing) as container:
        stream: Any = container.add_stream(codec, rate=Fraction(rate))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {**QUALITY[codec], "bf": "0", "g": "8", **options}
        stream.codec_context.time_base = unit if codec == "libx264" else Fraction(1, rate)
        packets = []
        for number in range(len(stamps)):
            pixels = np.full((HEIGHT, WIDTH, 3), gray(number), np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            # Encoders refuse repeated stamps, so packets get theirs afterwards.
            frame.pts, frame.time_base = number, Fraction(1, rate)
            packets += stream.encode(frame)
        packets += stream.encode()
        if codec == "libx264":
            for packet, stamp in zip(packets, stamps, strict=True):
                packet.pts = packet.dts = stamp
                packet.time_base, packet.duration = unit, PERIOD
            packets[-1].duration = last or PERIOD
        for packet in packets[cut:]:
            packet.stream = stream
            container.mux(packet)
    return path


def _repeat(path):
    """One frame has the time stamp of the one before it."""
    write_film(path, [1300 if t == 1400 else t for t in EVEN], format="matroska")


ALL = list(range(FRAMES))
FILMS = {
    "even": (write_film, ALL),
    "offset": (lambda path: write_film(path, [t + 4500 for t in EVEN], format="matroska"), ALL),
    "long last frame": (lambda path: write_film(path, last=20 * PERIOD), ALL),
    "missing frame": (
        lambda path: write_film(path, [t for t in EVEN if t != 1000]),
        [*range(11), *range(10, 23)],
    ),
    "repeated stamp": (_repeat, [*range(14), 15, *range(15, 24)]),
    "jitter": (lambda path: write_film(path, [t + (-1) ** (t // PERIOD) * 12 for t in EVEN]), ALL),
    "edit list": (lambda path: write_film(path, [t - 5 * PERIOD for t in EVEN]), ALL[5:]),
    "open group": (
        lambda path: write_film(path, codec="mpeg2video", format="mpegts", bf="2", g="9", cut=9),
        ALL[12:],
    ),
}
"""Writer of each film, and the number of its frame at each moment."""


def write_paused(path):
    """Frames 7 and 8 are 0.37 s apart."""
    return write_film(path, PAUSED)
