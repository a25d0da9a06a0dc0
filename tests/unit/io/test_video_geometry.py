"""Videos are shown as their files say: track, rotation, aspect and color, by every opener."""

import itertools
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.filter import Graph
from av.stream import Disposition

import egosim_jax
from egosim_jax.io import decoding
from egosim_jax.io.video import probe_video, read_moments, read_video
from egosim_jax.io.writing import encode_video
from egosim_jax.types import InputError

FRAMES = 9
HEIGHT, WIDTH = 96, 128


def shown_image(height=HEIGHT, width=WIDTH):
    """Smooth, and different at every rotation and mirroring."""
    y, x = np.meshgrid(np.linspace(0, 1, height), np.linspace(0, 1, width), indexing="ij")
    return np.stack([40 + 150 * y, 60 + 120 * x, 200 - 90 * x * y], axis=-1).astype(np.uint8)


@dataclass(frozen=True, kw_only=True)
class Track:
    """One stream of a file: what it stores, and what the file says of it."""

    image: np.ndarray
    codec: str = "libx264"
    pix_fmt: str = "yuv420p"
    aspect: Fraction | None = None
    rotation: float | None = None
    mirrored: bool = False
    disposition: Disposition | None = None
    frames: int = FRAMES
    interlaced: bool = False
    x264: str = ""
    color: tuple[int, int, int] | None = None
    """Primaries, transfer function and matrix of ITU-T H.273."""


OPTIONS = {
    "libx264": {"crf": "4"},
    "libx265": {"x265-params": "log-level=none:crf=4"},
    "libvpx-vp9": {"crf": "8", "b:v": "0", "cpu-used": "8"},
}


def write_tracks(path, *tracks):
    """Write the tracks of a file, frame by frame, in the order of their times."""
    with av.open(str(path), "w") as container:
        streams = []
        for track in tracks:
            height, width, _ = track.image.shape
            stream = container.add_stream(track.codec, rate=30)
            stream.width, stream.height, stream.pix_fmt = width, height, track.pix_fmt
            stream.options = dict(OPTIONS.get(track.codec, {}))
            if track.x264:
                stream.options["x264-params"] = track.x264
            if track.interlaced:
                stream.codec_context.flags |= av.codec.context.Flags.interlaced_dct
            if track.aspect is not None:
                stream.codec_context.sample_aspect_ratio = track.aspect
            if track.rotation is not None or track.mirrored:
                stream.set_display_rotation(track.rotation or 0, hflip=track.mirrored)
            if track.disposition is not None:
                stream.disposition = track.disposition
            if track.color is not None:
                coder = stream.codec_context
                coder.color_primaries, coder.color_trc, coder.colorspace = track.color
            streams.append(stream)
        for index in range(FRAMES):
            for track, stream in zip(tracks, streams, strict=True):
                if index < track.frames:
                    frame = av.VideoFrame.from_ndarray(track.image, format="rgb24")
                    matrix = {1: 1, 9: 9}.get(track.color[2] if track.color else 0)
                    frame = frame.reformat(format=track.pix_fmt, dst_colorspace=matrix)
                    container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode())
    return path


def squeezed(image, aspect):
    """Store an image with pixels that are `aspect` times as wide as high."""
    return cv2.resize(
        image, (round(image.shape[1] / aspect), image.shape[0]), interpolation=cv2.INTER_AREA
    )


OTHER = np.full((48, 64, 3), 90, np.uint8)
WIDE = Fraction(4, 3)
NARROW = Fraction(2, 3)
UP = shown_image()

READ: dict[str, tuple[str, np.ndarray, list[Track]]] = {
    "plain": ("mp4", UP, [Track(image=UP)]),
    "aspect-of-mp4": ("mp4", UP, [Track(image=squeezed(UP, WIDE), aspect=WIDE)]),
    "aspect-of-codec-only": ("ts", UP, [Track(image=squeezed(UP, WIDE), aspect=WIDE)]),
    "aspect-of-container-only": (
        "mp4",
        UP,
        [Track(image=squeezed(UP, WIDE), aspect=WIDE, codec="libvpx-vp9")],
    ),
    "pixels-higher-than-wide": ("mkv", UP, [Track(image=squeezed(UP, NARROW), aspect=NARROW)]),
    "rounding-is-no-aspect": ("mp4", UP, [Track(image=UP, aspect=Fraction(1280, 1281))]),
    "rotated-90": ("mp4", np.rot90(UP), [Track(image=UP, rotation=90)]),
    "rotated-180": ("mov", np.rot90(UP, 2), [Track(image=UP, rotation=180)]),
    "rotated-90-and-mirrored": (
        "mp4", np.rot90(UP)[:, ::-1], [Track(image=UP, rotation=90, mirrored=True)],
    ),
    "rotated-180-and-mirrored": (
        "mp4", UP[::-1], [Track(image=UP, rotation=180, mirrored=True)],
    ),
    "rotated-270-and-aspect": (
        "mp4",
        np.rot90(UP, 3),
        [Track(image=squeezed(UP, WIDE), aspect=WIDE, rotation=270)],
    ),
    "mirrored-and-aspect": (
        "mp4",
        UP[:, ::-1],
        [Track(image=squeezed(UP, NARROW), aspect=NARROW, mirrored=True)],
    ),
    "default-track-second": (
        "mp4",
        UP,
        [
            Track(image=OTHER, disposition=Disposition(0)),
            Track(image=UP, disposition=Disposition.default),
        ],
    ),
    "default-track-second-in-matroska": (
        "mkv",
        UP,
        [
            Track(image=OTHER, disposition=Disposition.original),
            Track(image=UP, disposition=Disposition.default),
        ],
    ),
    "two-default-tracks": (
        "mkv",
        UP,
        [
            Track(image=UP, disposition=Disposition.default),
            Track(image=OTHER, disposition=Disposition.default),
        ],
    ),
    "cover-art-first": (
        "mp4",
        UP,
        [
            Track(image=OTHER, codec="mjpeg", pix_fmt="yuvj420p", frames=1,
                  disposition=Disposition.attached_pic),
            Track(image=UP),
        ],
    ),
    "still-track-first": (
        "mov",
        UP,
        [Track(image=OTHER, codec="mjpeg", pix_fmt="yuvj420p", frames=1), Track(image=UP)],
    ),
    "full-range": ("mp4", UP, [Track(image=UP, codec="mjpeg", pix_fmt="yuvj444p")]),
    "bt709-matrix": ("mp4", UP, [Track(image=UP, color=(1, 1, 1))]),
    "ten-bits": ("mp4", UP, [Track(image=UP, codec="libx265", pix_fmt="yuv420p10le")]),
}  # fmt: skip

PQ = Track(image=UP, codec="libx265", pix_fmt="yuv420p10le", color=(9, 16, 9))
HLG = Track(image=UP, codec="libx265", pix_fmt="yuv420p10le", color=(9, 18, 9))
REFUSED: dict[str, tuple[str, str, list[Track]]] = {
    "pq": ("mp4", "HDR .*PQ.*out_transfer=bt709", [PQ]),
    "hlg": ("mkv", "HDR .*HLG.*out_transfer=bt709", [HLG]),
    "hlg-in-8-bits": ("mp4", "HDR .*HLG", [Track(image=UP, color=(9, 18, 9))]),
    "hlg-of-the-codec-only": ("ts", "HDR .*HLG", [HLG]),
    "logarithmic": ("mkv", "logarithmic", [Track(image=UP, color=(1, 9, 1))]),
    "hdr-track-is-the-default": (
        "mp4",
        "HDR .*PQ",
        [
            Track(image=OTHER, disposition=Disposition(0)),
            Track(image=UP, color=(9, 16, 9), disposition=Disposition.default),
        ],
    ),
    "matrix-of-ycgco": ("mkv", "matrix 8", [Track(image=UP, color=(1, 1, 8))]),
    "interlaced": ("mp4", "interlaced.*bwdif", [Track(image=UP, interlaced=True)]),
    "two-views-in-a-frame": (
        "mkv", "stereoscopic.*stereo3d", [Track(image=UP, x264="frame-packing=3")],
    ),
    "oblique": ("mp4", "not a multiple of 90", [Track(image=UP, rotation=30)]),
}  # fmt: skip


def probed(path: Path) -> np.ndarray:
    info = probe_video(path)
    assert info.frames == FRAMES
    return np.broadcast_to(np.uint8(0), (info.height, info.width, 3))


OPENERS: dict[str, Callable[[Path], np.ndarray]] = {
    "read": lambda path: read_video(path).frames[1],
    "official": lambda path: read_video(path, stop=2, decoding="official").frames[1],
    "bytes": lambda path: read_video(path.read_bytes(), start=1, stop=4).frames[0],
    "moments": lambda path: read_moments(path, np.array([1 / 30])).frames[0],
    "probe": probed,
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return a function that writes a member once and gives its path."""
    folder = tmp_path_factory.mktemp("videos")

    @cache
    def write(member: str) -> Path:
        suffix, _, tracks = (READ | REFUSED)[member]
        return write_tracks(folder / f"{member}.{suffix}", *tracks)

    return write


@pytest.mark.parametrize("member", READ)
def test_a_video_is_read_as_it_is_shown_by_every_opener(written, member):
    _, expected, _ = READ[member]
    for name, opener in OPENERS.items():
        frame = opener(written(member))
        assert frame.shape == expected.shape, name
        if frame.any():
            assert np.abs(frame.astype(int) - expected)[4:-4, 4:-4].max() <= 8, name


@pytest.mark.parametrize("member", REFUSED)
def test_a_video_that_would_be_misread_is_refused_by_every_opener(written, member):
    for opener in OPENERS.values():
        with pytest.raises(InputError, match=REFUSED[member][1]):
            opener(written(member))


def test_only_one_module_opens_videos():
    """The others go through `open_video`, so that none has its own idea of geometry and color.

    OpenCV opens cameras alone, by their numbers.
    """
    package = Path(egosim_jax.__file__).parent
    found = {
        str(path.relative_to(package)): sorted(set(re.findall(r"av\.open|VideoCapture", text)))
        for path in package.rglob("*.py")
        if re.search(r"\bav\.open|VideoCapture", text := path.read_text())
    }
    assert found.pop("io/shots.py") == ["VideoCapture"]
    assert (package / "io/shots.py").read_text().count("cv2.VideoCapture(number)") == 1
    assert found == {"io/decoding.py": ["av.open"], "io/writing.py": ["av.open"]}
    assert (package / "io/writing.py").read_text().count('av.open(file, "w"') == 1


def test_colors_of_bt2020_are_converted(tmp_path):
    """Expected by the matrix of ITU-R BT.2087 between displays with a gamma of 2.4."""
    stored = np.full((HEIGHT, WIDTH, 3), (128, 77, 51), np.uint8)
    track = Track(image=stored, codec="libx265", pix_fmt="yuv420p10le", color=(9, 14, 9))
    frame = read_video(write_tracks(tmp_path / "a.mp4", track)).frames[0]
    linear = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083],
                       [-0.0182, -0.1006, 1.1187]]) @ (stored[0, 0] / 255) ** 2.4  # fmt: skip
    assert np.abs(frame[48, 64] - 255 * linear ** (1 / 2.4)).max() <= 8


def test_frames_that_square_pixels_make_too_large_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(decoding, "MAX_IMAGE_PIXELS", 10 * HEIGHT * WIDTH)
    path = write_tracks(tmp_path / "a.mkv", Track(image=UP, aspect=Fraction(20)))
    with pytest.raises(InputError, match="square pixels"):
        read_video(path)


def _ready(graph):
    while True:
        try:
            yield graph.vpull()
        except (av.BlockingIOError, av.EOFError):
            return


def converted(path, target, *filters):
    """Do what `ffmpeg -i path -vf filters target` does, by the filters of the same library."""
    with av.open(str(path)) as source, av.open(str(target), "w") as container:
        old = source.streams.video[0]
        new = container.add_stream("libx264", rate=old.average_rate)
        new.width, new.height, new.pix_fmt = old.width, old.height, "yuv420p"
        graph = Graph()
        nodes = [graph.add_buffer(template=old), *(graph.add(*f.split("=", 1)) for f in filters)]
        graph.link_nodes(*nodes, graph.add("buffersink")).configure()
        numbers = itertools.count()
        for frame in [*source.decode(old), None]:
            graph.vpush(frame)
            for coded in _ready(graph):
                coded.pts, coded.time_base = next(numbers), 1 / old.average_rate
                coder = new.codec_context
                coder.color_primaries, coder.color_trc = coded.color_primaries, coded.color_trc
                container.mux(new.encode(coded))
        container.mux(new.encode())
    return target


@pytest.mark.parametrize("member", ["pq", "hlg", "interlaced"])
def test_the_advised_conversion_is_read(written, tmp_path, member):
    path = written(member)
    with pytest.raises(InputError) as caught:
        read_video(path)
    (filters,) = re.findall(r"-vf (\S+) OUT", str(caught.value))
    back = read_video(converted(path, tmp_path / "b.mp4", *filters.split(",")))
    assert back.frames.shape[1:] == UP.shape
    assert len(back.frames) >= FRAMES - 1


def box(kind, *content):
    return struct.pack(">I4s", 8 + sum(map(len, content)), kind) + b"".join(content)


def described(data, *boxes):
    """An MP4 whose sample description ends with some boxes."""
    data, more, start, end = bytearray(data), b"".join(boxes), 0, 0
    for kind, fields in {b"moov": 0, b"trak": 0, b"mdia": 0, b"minf": 0, b"stbl": 0,
                         b"stsd": 8, b"avc1": 78}.items():  # fmt: skip
        while data[start + 4 : start + 8] != kind:
            start += struct.unpack_from(">I", data, start)[0]
        (size,) = struct.unpack_from(">I", data, start)
        struct.pack_into(">I", data, start, size + len(more))
        start, end = start + 8 + fields, start + size
    return bytes(data[:end]) + more + bytes(data[end:])


def test_a_crop_of_mp4_is_refused():
    data = encode_video(np.stack([UP] * 3), 8)

    def cropped(width, height):
        return described(data, box(b"clap", struct.pack(">8I", width, 1, height, 1, 0, 1, 0, 1)))

    assert read_video(cropped(WIDTH, HEIGHT)).frames.shape == (3, HEIGHT, WIDTH, 3)
    for width, height in ((WIDTH - 8, HEIGHT), (WIDTH, HEIGHT // 2)):
        with pytest.raises(InputError, match=r"cropped .*ffmpeg -i IN"):
            read_video(cropped(width, height))


def test_a_spherical_video_is_refused():
    """Its boxes are Google's, of Spherical Video V2."""
    projection = box(b"proj", box(b"prhd", bytes(16)), box(b"equi", bytes(20)))
    sphere = box(b"sv3d", box(b"svhd", bytes(4), b"camera\0"), projection)
    data = described(encode_video(np.stack([UP] * 3), 8), sphere)
    for opener in (read_video, probe_video):
        with pytest.raises(InputError, match=r"spherical.*v360"):
            opener(data)


@pytest.mark.parametrize("crop", [0xAA, 0xBB, 0xCC, 0xDD], ids=["bottom", "top", "left", "right"])
def test_a_crop_of_matroska_is_refused(tmp_path, crop):
    data = write_tracks(tmp_path / "a.mkv", Track(image=UP)).read_bytes()
    unit = b"\x54\xb2\x81\x04"  # DisplayUnit, which makes room
    assert data.count(unit) == 1
    none, some = (data.replace(unit, bytes([0x54, crop, 0x81, n])) for n in (0, 8))
    assert probe_video(none).width == WIDTH
    with pytest.raises(InputError, match=r"PixelCrop.*ffmpeg -i IN"):
        probe_video(some)
