"""Images are read as RGB; invalid ones are refused."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from egosim_jax.io import images
from egosim_jax.io.images import read_image
from egosim_jax.types import InputError


def test_an_image_with_transparency_reads_as_rgb(tmp_path):
    Image.new("RGBA", (6, 4), (10, 20, 30, 128)).save(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png")
    assert image.shape == (4, 6, 3)
    assert (image == (10, 20, 30)).all()


def test_an_image_above_the_cap_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(images, "MAX_IMAGE_PIXELS", 6 * 4 - 1)
    Image.new("RGB", (6, 4)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="6x4 pixels"):
        read_image(tmp_path / "a.png")


def png(*chunks):
    """Return a PNG with these chunks."""
    parts = [b"\x89PNG\r\n\x1a\n"]
    for kind, content in chunks:
        crc = zlib.crc32(kind + content)
        parts.append(struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc))
    return b"".join(parts)


HEADER = (b"IHDR", struct.pack(">IIBBBBB", 4, 4, 8, 2, 0, 0, 0))
PIXELS = (b"IDAT", zlib.compress(b"".join(b"\0" + bytes(12) for _ in range(4))))


def test_an_image_of_32_bits_is_refused(tmp_path):
    Image.fromarray(np.ones((4, 4), np.float32)).save(tmp_path / "a.tiff")
    with pytest.raises(InputError, match="32 bits"):
        read_image(tmp_path / "a.tiff")


END = (b"IEND", b"")
WHOLE = png(HEADER, PIXELS, END)
AT = WHOLE.index(b"IDAT") + 6
BOMB = (b"zTXt", b"a\0\0" + zlib.compress(bytes(1 << 27)))
UNREADABLE = {
    "text": b"no image",
    "cut off": WHOLE[: len(WHOLE) // 2],
    "text bomb": png(HEADER, BOMB, PIXELS, END),
    "wrong byte": WHOLE[:AT] + b"?" + WHOLE[AT + 1 :],
}


@pytest.mark.parametrize("damage", UNREADABLE)
def test_a_damaged_image_is_refused_by_name(tmp_path, damage):
    (tmp_path / "a.png").write_bytes(UNREADABLE[damage])
    with pytest.raises(InputError, match=r"a\.png is not a readable image"):
        read_image(tmp_path / "a.png")
