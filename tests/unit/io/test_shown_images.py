"""Images are read as viewers show them: turned by EXIF, in sRGB, or refused."""

import io
import struct

import numpy as np
import pytest
from PIL import Image, ImageCms, ImageOps, PngImagePlugin

from egosim_jax.io.images import decode_image, decode_labels, read_depth_image, read_image
from egosim_jax.types import InputError

COLORS = np.array(
    [[[200, 40, 40], [40, 180, 60], [60, 60, 200]], [[220, 220, 220], [90, 90, 20], [20, 90, 90]]],
    np.uint8,
)
BLOCKS = COLORS.repeat(16, 0).repeat(16, 1)
"""An image of blocks, so that JPEG keeps their colors."""
D50 = {
    "srgb": [[0.4360, 0.3851, 0.1431], [0.2225, 0.7169, 0.0606], [0.0139, 0.0971, 0.7141]],
    "display_p3": [[0.5151, 0.2920, 0.1571], [0.2412, 0.6922, 0.0666], [-0.0011, 0.0419, 0.7841]],
    "adobe_rgb": [[0.6097, 0.2053, 0.1492], [0.3111, 0.6257, 0.0632], [0.0195, 0.0609, 0.7446]],
}


def encode(image, form, **options):
    data = io.BytesIO()
    lossless = {"lossless": True} if form == "WEBP" else {}
    more = {"save_all": True, "append_images": [image]} if form == "MPO" else {}
    image.save(data, form, **lossless, **more, **options)
    return data.getvalue()


def tagged(image, form, turn):
    exif = Image.Exif()
    exif[0x0112] = turn
    return encode(Image.fromarray(image), form, exif=exif)


def turned(image, turn):
    """Return the image as Pillow shows it."""
    other = Image.fromarray(image)
    exif = Image.Exif()
    exif[0x0112] = turn
    other.info["exif"] = exif.tobytes()
    return np.asarray(ImageOps.exif_transpose(other))


def matrix_profile(space, gamma=2.2):
    """Return an ICC profile of three primaries and a gamma."""

    def xyz(values):
        return b"XYZ \0\0\0\0" + b"".join(struct.pack(">i", round(65536 * v)) for v in values)

    curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(256 * gamma)) + b"\0\0"
    primaries = np.array(D50[space]).T
    tags = {
        b"desc": b"desc\0\0\0\0" + struct.pack(">I", 2) + b"x\0" + bytes(78),
        b"wtpt": xyz([0.9642, 1.0, 0.8249]),
        **{c + b"XYZ": xyz(p) for c, p in zip((b"r", b"g", b"b"), primaries, strict=True)},
        **{c + b"TRC": curve for c in (b"r", b"g", b"b")},
    }
    at, table, body = 128 + 4 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        table += name + struct.pack(">II", at + len(body), len(content))
        body += content
    size = 128 + len(table) + len(body)
    head = struct.pack(">I4xI4s4s4s", size, 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    head += bytes(12) + b"acsp" + bytes(28) + struct.pack(">3i", 63190, 65536, 54061)
    return head.ljust(128, b"\0") + table + body


def to_srgb(colors, space, gamma=2.2):
    """Convert by the definition of both spaces, without Pillow."""
    linear = np.array(colors / 255.0) ** (round(256 * gamma) / 256)
    found = np.clip(linear @ np.array(D50[space]).T @ np.linalg.inv(D50["srgb"]).T, 0, 1)
    low = found <= 0.0031308
    return 255 * np.where(low, 12.92 * found, 1.055 * found ** (1 / 2.4) - 0.055)


def read_file(path, data, **options):
    path.write_bytes(data)
    return read_image(path, **options)


@pytest.mark.parametrize("turn", range(1, 9))
@pytest.mark.parametrize("form", ["JPEG", "MPO", "PNG", "WEBP", "TIFF"])
def test_orientation(tmp_path, form, turn):
    data = tagged(BLOCKS, form, turn)
    allowed = 6 if form in ("JPEG", "MPO") else 0
    shown = read_file(tmp_path / "a", data).astype(int)
    assert shown.shape == turned(BLOCKS, turn).shape
    np.testing.assert_array_equal(shown, decode_image(data))
    stored = decode_image(data, pixels="stored").astype(int)
    assert stored.shape == BLOCKS.shape
    centers = (slice(8, None, 16), slice(8, None, 16))
    assert np.abs(stored - BLOCKS)[centers].max() <= allowed
    assert np.abs(shown - turned(BLOCKS, turn))[centers].max() <= allowed


@pytest.mark.parametrize("turn", [0, 9, 255])
def test_an_orientation_that_does_not_exist_turns_nothing(turn):
    np.testing.assert_array_equal(decode_image(tagged(BLOCKS, "PNG", turn)), BLOCKS)


def test_damaged_exif_turns_nothing():
    data = encode(Image.fromarray(BLOCKS), "PNG", exif=b"Exif\0\0MM\0*\xff\xff\xff\xff")
    np.testing.assert_array_equal(decode_image(data), BLOCKS)


@pytest.mark.parametrize("form", ["JPEG", "PNG", "TIFF", "WEBP"])
@pytest.mark.parametrize(("space", "gamma"), [("display_p3", 2.2), ("adobe_rgb", 2.19921875)])
def test_an_embedded_profile_is_converted(form, space, gamma):
    profile = matrix_profile(space, gamma)
    options = {"quality": 100, "subsampling": 0} if form == "JPEG" else {}
    found = decode_image(encode(Image.fromarray(BLOCKS), form, icc_profile=profile, **options))
    expected = to_srgb(COLORS, space, gamma)
    assert np.abs(found[8::16, 8::16] - expected).max() < 4
    assert np.abs(COLORS - expected).max() > 10


@pytest.mark.parametrize("mode", ["RGB", "L", "P"])
def test_a_profile_of_srgb_changes_no_color(mode):
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    image = Image.fromarray(BLOCKS).convert(mode)
    found = decode_image(encode(image, "PNG", icc_profile=profile))
    np.testing.assert_array_equal(found, np.asarray(image.convert("RGB")))


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "I;16"])
def test_gray_palette_and_16_bits_are_read(mode):
    image = Image.fromarray(BLOCKS).convert("L" if mode == "I;16" else mode)
    expected = np.asarray(image.convert("RGB"))
    if mode == "I;16":
        image = Image.fromarray(np.asarray(image).astype(np.uint16) << 8)
    np.testing.assert_array_equal(decode_image(encode(image, "PNG")), expected)


def transparent(mode, form="PNG"):
    image = Image.fromarray(np.dstack([BLOCKS, np.full(BLOCKS.shape[:2], 255, np.uint8)]), "RGBA")
    image.paste((0, 0, 0, 0), (0, 0, 5, 5))
    return encode(image.convert(mode), form)


def palette():
    image = Image.fromarray(BLOCKS).convert("P")
    return encode(image, "PNG", transparency=image.getpixel((0, 0)))


def chunk(name, content):
    info = PngImagePlugin.PngInfo()
    info.add(name, content)
    return encode(Image.fromarray(BLOCKS), "PNG", pnginfo=info)


def adobe_rgb_of_a_camera():
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 2
    return encode(Image.fromarray(BLOCKS), "JPEG", exif=exif)


IMAGE = Image.fromarray(BLOCKS)
REFUSED = {
    "rgba": (lambda: transparent("RGBA"), "transparent pixels.*-flatten"),
    "gray_alpha": (lambda: transparent("LA"), "transparent pixels.*-flatten"),
    "webp_alpha": (lambda: transparent("RGBA", "WEBP"), "transparent pixels.*-flatten"),
    "palette_alpha": (palette, "transparent pixels.*-flatten"),
    "cmyk_jpeg": (lambda: encode(IMAGE.convert("CMYK"), "JPEG"), "CMYK.*-colorspace sRGB"),
    "cmyk_tiff": (lambda: encode(IMAGE.convert("CMYK"), "TIFF"), "CMYK.*-colorspace sRGB"),
    "linear_png": (lambda: chunk(b"gAMA", struct.pack(">I", 100_000)), "gamma is 1, not"),
    "wide_png": (
        lambda: chunk(
            b"cHRM",
            struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000),
        ),
        "primaries are not sRGB",
    ),
    "pq_png": (lambda: chunk(b"cICP", bytes([9, 16, 0, 1])), r"HDR \(PQ\)"),
    "hlg_png": (lambda: chunk(b"cICP", bytes([9, 18, 0, 1])), r"HDR \(HLG\)"),
    "camera_adobe_rgb": (adobe_rgb_of_a_camera, "EXIF says Adobe RGB"),
    "broken_profile": (
        lambda: encode(IMAGE, "JPEG", icc_profile=b"no profile" * 20),
        "profile that cannot be used",
    ),
    "jpeg_aspect": (lambda: encode(IMAGE, "JPEG", dpi=(72, 144)), "not square.*-density"),
    "png_aspect": (lambda: encode(IMAGE, "PNG", dpi=(100, 75)), "not square.*-density"),
    "tiff_aspect": (lambda: encode(IMAGE, "TIFF", dpi=(204, 98)), "not square.*-density"),
    "gif": (lambda: encode(IMAGE, "GIF"), "must be PNG or JPEG"),
    "heic": (lambda: b"\0\0\0\x18ftypheic" + bytes(40), "must be PNG or JPEG"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_colors_and_shapes_that_are_not_known_are_refused_with_a_fix(name):
    make, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        decode_image(make())


def test_the_shape_of_stored_pixels_is_of_their_camera():
    data = encode(IMAGE, "PNG", dpi=(100, 75))
    np.testing.assert_array_equal(decode_image(data, pixels="stored"), BLOCKS)


@pytest.mark.parametrize("mode", ["L", "P", "I;16"])
def test_labels_are_the_stored_numbers(mode):
    numbers = np.arange(24, dtype=np.uint16 if mode == "I;16" else np.uint8).reshape(4, 6)
    image = Image.fromarray(numbers)
    if mode == "P":
        image = Image.frombytes("P", (6, 4), numbers.tobytes())
        image.putpalette(list(range(255, -1, -1)) * 3)
    np.testing.assert_array_equal(decode_labels(encode(image, "PNG"), "labels"), numbers)
    with pytest.raises(InputError, match="one channel"):
        decode_labels(encode(IMAGE, "PNG"), "labels")


def test_depth_keeps_16_bits(tmp_path):
    depth = np.arange(0, 60_000, 2500, dtype=np.uint16).reshape(4, 6)
    Image.fromarray(depth).save(tmp_path / "d.png")
    np.testing.assert_array_equal(read_depth_image(tmp_path / "d.png"), depth)
