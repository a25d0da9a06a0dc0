"""Images are read as RGB; invalid ones are refused."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from egosim_jax.io import images
from egosim_jax.io.images import decode_image, read_image
from egosim_jax.types import InputError


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
    monkeypatch.setattr(images, "MAX_IMAGE_PIXELS", 6 * 4 - 1)
    Image.new("RGB", (6, 4)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="6x4 pixels"):
        read_image(tmp_path / "a.png")


def test_gray_of_16_bits_keeps_its_upper_8(tmp_path):
    levels = np.arange(0, 65536, 4096, dtype=np.uint16).reshape(4, 4)
    Image.fromarray(levels).save(tmp_path / "a.png")
    expected = np.repeat((levels >> 8).astype(np.uint8)[..., None], 3, axis=-1)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), expected)


def png(*chunks):
    """Return a PNG with these chunks."""
    parts = [b"\x89PNG\r\n\x1a\n"]
    for kind, content in chunks:
        crc = zlib.crc32(kind + content)
        parts.append(struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc))
    return b"".join(parts)


HEADER = (b"IHDR", struct.pack(">IIBBBBB", 4, 4, 8, 2, 0, 0, 0))
PIXELS = (b"IDAT", zlib.compress(b"".join(b"\0" + bytes(12) for _ in range(4))))


def test_a_png_with_a_text_bomb_is_refused():
    bomb = (b"zTXt", b"a\0\0" + zlib.compress(bytes(1 << 27)))
    with pytest.raises(InputError, match="is not a readable image"):
        decode_image(png(HEADER, bomb, PIXELS, (b"IEND", b"")))


def test_a_png_with_one_wrong_byte_of_pixels_is_refused():
    data = png(HEADER, PIXELS, (b"IEND", b""))
    at = data.index(b"IDAT") + 6
    with pytest.raises(InputError, match="is not a readable image"):
        decode_image(data[:at] + b"?" + data[at + 1 :])


def test_an_image_of_32_bits_is_refused(tmp_path):
    Image.fromarray(np.ones((4, 4), np.float32)).save(tmp_path / "a.tiff")
    with pytest.raises(InputError, match="32 bits"):
        read_image(tmp_path / "a.tiff")
