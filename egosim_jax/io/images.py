"""Read images as uint8 RGB arrays, and depth maps, checked before they are decoded.

Every image of a user is opened here. An image is read as viewers show it: turned as EXIF says, in
sRGB of 8 bits. Cameras of a reconstruction (COLMAP, nerfstudio) are of the pixels as they are
stored; its readers ask for `pixels="stored"`.

An embedded profile (Display P3 of phones, Adobe RGB) is converted to sRGB. Refused are pixels
without a color (transparent), CMYK without a profile, and colors that other fields say are not
sRGB: gamma, primaries or HDR of a PNG, Adobe RGB in EXIF.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Shaped, UInt8
from PIL import ExifTags, Image, ImageCms, UnidentifiedImageError

from egosim_jax.io.bounded import quote_path, quote_text, read_bytes, refusing
from egosim_jax.io.untrusted.npz import read_npy
from egosim_jax.types import InputError

Pixels = Literal["shown", "stored"]
"""Pixels turned as EXIF says, or as they are in the file."""
MAX_IMAGE_PIXELS = 2**25
"""Maximum number of pixels of one image or frame: 8192 x 4096."""
MAX_IMAGE_BYTES = 2**28
"""Maximum size of an image file in bytes."""
IMAGES = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "PPM")
"""Image formats that can be read."""
MAX_PIXEL_ASPECT = 0.02
"""Maximum relative difference between width and height of a pixel that counts as square."""
MAX_PROFILE_BYTES = 1 << 22
"""Maximum size of a color profile in bytes."""
SRGB_LEVELS = 3
"""Maximum change of a color, in levels of 255, by a profile that counts as sRGB."""
_GAMMA, _PRIMARIES = 0.45455, (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
_ADOBE_RGB = 2
_HDR = {16: "PQ", 18: "HLG"}
_FIX = (
    "Save it as an 8-bit RGB image in sRGB, for instance by `magick IN -colorspace sRGB OUT.png`."
)
_INVERSE = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
"""Orientation that undoes each EXIF orientation."""


def read_image(path: Path, *, pixels: Pixels = "shown") -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as RGB. Raises `InputError` if it is missing, damaged or too large."""
    data = read_bytes(path, limit=MAX_IMAGE_BYTES)
    return decode_image(data, name=quote_path(path), pixels=pixels)


def decode_image(
    data: bytes, *, name: str = "the encoded image", pixels: Pixels = "shown"
) -> UInt8[np.ndarray, "h w 3"]:
    """Decode the bytes of an image file (`read_image`); `name` replaces the path in errors.

    The upper 8 of 16 bits are kept.
    """
    with refusing(f"{name} is not a readable image"):
        with _open(data, name, IMAGES) as image:
            if image.mode in ("I", "F"):
                raise InputError(f"{name} has 32 bits a channel; save it with 8 or 16.")
            if image.format == "PNG":
                image.verify()  # checks the CRC of every chunk and consumes the file: open it again
        if hdr := _hdr_of_png(data):
            raise InputError(f"{name} is HDR ({hdr}), which is not read. {_FIX}")
        with _open(data, name, IMAGES) as image:
            turn = _orientation(image)
            image.load()
            if pixels == "shown":
                _check_square(image, name)
            colors = _to_srgb(image, name)
            # Pillow turns a TIFF itself, and removes the tag.
            turned = image.format == "TIFF" and _orientation(image) == 1
        if turned == (pixels == "shown"):
            return colors
        return _turn(colors, turn if pixels == "shown" else _INVERSE[turn])


def decode_labels(data: bytes, name: str) -> Shaped[np.ndarray, "h w"]:
    """Return the stored numbers of a PNG with one channel: gray levels, or indices of a palette."""
    with refusing(f"{name} is not a readable PNG"), _open(data, name, ("PNG",)) as image:
        if image.mode not in ("1", "L", "P") and not image.mode.startswith("I"):
            raise InputError(
                f"{name} has channels {image.mode}: it must be a PNG with one channel."
            )
        return np.asarray(image.convert("L") if image.mode == "1" else image)


def _open(data: bytes, name: str, formats: tuple[str, ...]) -> Image.Image:
    try:
        image = Image.open(io.BytesIO(data), formats=formats)
    except UnidentifiedImageError:
        raise InputError(
            f"{name} is not a readable image: it must be {' or '.join(formats)}. Convert it, for "
            "instance by `magick IN OUT.png`."
        ) from None
    if image.width * image.height > MAX_IMAGE_PIXELS:
        raise InputError(
            f"{name} has {image.width}x{image.height} pixels, more than "
            f"{MAX_IMAGE_PIXELS:,}, the maximum."
        )
    return image


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation, from 1 to 8; 1, as stored, if it is missing or invalid."""
    try:
        turn = image.getexif().get(ExifTags.Base.Orientation)
    except Exception:  # damaged EXIF says nothing, as in every viewer
        return 1
    return turn if turn in _INVERSE else 1


def _turn(colors: UInt8[np.ndarray, "h w 3"], turn: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return the image as EXIF's orientation shows it."""
    if turn >= 5:
        colors = colors.transpose(1, 0, 2)
    rows = -1 if turn in (3, 4, 7, 8) else 1
    columns = -1 if turn in (2, 3, 6, 7) else 1
    return np.ascontiguousarray(colors[::rows, ::columns])


def _check_square(image: Image.Image, name: str) -> None:
    """Raise `InputError` if the file says that pixels are not square."""
    names = (name for name in ("dpi", "aspect", "jfif_density") if name in image.info)
    across, down = map(float, image.info.get(next(names, ""), (1, 1)))
    if across > 0 and down > 0 and abs(across / down - 1) > MAX_PIXEL_ASPECT:
        raise InputError(
            f"{name} has {across:.4g} pixels per unit across and {down:.4g} down: its pixels are "
            "not square. Resize it to square pixels, or correct its resolution, for instance by "
            "`magick IN -density 72 OUT.png`."
        )


def _to_srgb(image: Image.Image, name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Return the colors of a loaded image. Raises `InputError` if they are not known.

    The color of a partly transparent pixel is its own, without a background.
    """
    info = dict(image.info)
    if image.mode.startswith("I;16"):
        if "transparency" in info:
            _refuse_transparent(name)
        image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
    elif image.has_transparency_data and not np.asarray(image.convert("RGBA"))[..., 3].all():
        _refuse_transparent(name)
    profile = info.get("icc_profile")
    if profile:
        return _convert(image, profile, name)
    if image.mode == "CMYK":
        raise InputError(f"{name} has CMYK colors and no color profile for them. {_FIX}")
    if why := _other_space(image, info):
        raise InputError(f"{name} has colors that are not sRGB: {why}. {_FIX}")
    return np.asarray(image.convert("RGB"))


def _hdr_of_png(data: bytes) -> str | None:
    """Return PQ or HLG if a PNG says that it is HDR (chunk cICP)."""
    at = 8
    while data.startswith(b"\x89PNG") and at + 12 <= len(data):
        (length,), kind = struct.unpack_from(">I", data, at), data[at + 4 : at + 8]
        if kind == b"cICP" and length == 4:
            return _HDR.get(data[at + 9])
        if kind == b"IDAT":
            return None
        at += 12 + length
    return None


def _refuse_transparent(name: str) -> None:
    raise InputError(
        f"{name} has transparent pixels, which have no color: fill them, for instance by "
        "`magick IN -background white -flatten OUT.png`."
    )


def _convert(image: Image.Image, profile: bytes, name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Return the colors of an image with a profile; unchanged if that is sRGB."""
    try:
        if len(profile) > MAX_PROFILE_BYTES:
            raise ValueError(f"it has {len(profile):,} bytes")
        source: Any = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        space = source.profile.xcolor_space.strip()
        mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}[space]
        if (mode == "L") > (image.mode in ("1", "L", "LA", "La")) or (
            (mode == "CMYK") != (image.mode == "CMYK")
        ):
            raise ValueError(f"it is for {space}, the image has {image.mode}")
        colors = image.convert(mode)
        change: Any = ImageCms.buildTransform(
            source,
            ImageCms.createProfile("sRGB"),
            mode,
            "RGB",
            renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
            flags=ImageCms.Flags.BLACKPOINTCOMPENSATION,
        )
        if mode != "CMYK":
            levels = np.arange(0, 256, 17, dtype=np.uint8)
            axes = [levels] * (3 if mode == "RGB" else 1)
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(1, -1, len(axes))
            sample = Image.fromarray(grid if mode == "RGB" else grid[..., 0])
            moved = np.asarray(ImageCms.applyTransform(sample, change)).astype(int)
            if np.abs(moved - grid).max() <= SRGB_LEVELS:
                return np.asarray(image.convert("RGB"))
        return np.asarray(ImageCms.applyTransform(colors, change))
    except (ImageCms.PyCMSError, OSError, ValueError, KeyError) as error:
        raise InputError(f"{name} has a color profile that cannot be used: {error}. {_FIX}") from (
            error
        )


def _other_space(image: Image.Image, info: dict[Any, Any]) -> str | None:
    """Return what an image without a profile says of its color space, unless that is sRGB."""
    if image.format == "PNG" or "gamma" in info or "chromaticity" in info:
        if "srgb" in info:
            return None
        if (gamma := info.get("gamma")) and abs(gamma / _GAMMA - 1) > 0.05:
            return f"their gamma is {gamma:g}, not {_GAMMA:g}"
        primaries = info.get("chromaticity")
        if primaries and np.abs(np.subtract(primaries, _PRIMARIES)).max() > 0.01:
            return "the primaries are not sRGB's"
    try:
        exif = image.getexif()
        adobe = exif.get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex) == "R03"
        adobe |= exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.ColorSpace) == _ADOBE_RGB
    except Exception:  # damaged EXIF says nothing, as in every viewer
        return None
    return "EXIF says Adobe RGB" if adobe else None


def read_depth_image(path: Path) -> Float32[np.ndarray, "h w"]:
    """Read a depth map, in the unit of the file.

    Raises `InputError` unless it is a 16-bit PNG with one channel, or an npy of numbers `h w`.
    """
    name, data = quote_path(path), read_bytes(path, limit=MAX_IMAGE_BYTES)
    try:
        if path.suffix.lower() == ".png":
            with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
                if image.width * image.height > MAX_IMAGE_PIXELS:
                    raise ValueError(f"{image.width}x{image.height} pixels")
                if not image.mode.startswith("I"):
                    raise ValueError(f"channels {image.mode}")
                return np.asarray(image).astype(np.float32)
        return read_npy(data, name).astype(np.float32)
    except (ValueError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(
            f"{name} is not a depth map: {quote_text(str(error))}. It must be a 16-bit PNG with "
            f"one channel, or an npy of numbers, at most {MAX_IMAGE_PIXELS:,} pixels."
        ) from error
