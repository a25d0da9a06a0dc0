"""Colors of an opened image as sRGB of 8 bits, or a refusal if the file does not determine them.

An embedded profile (Display P3 of phones, Adobe RGB) is converted to sRGB. Refused are pixels
without a color (transparent), CMYK without a profile, and colors that other fields say are not
sRGB: gamma, primaries or HDR of a PNG, Adobe RGB in EXIF.
"""

from __future__ import annotations

import io
import struct
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image, ImageCms

from egosim_jax.types import InputError

MAX_PROFILE_BYTES = 1 << 22
"""Maximum size of a color profile in bytes."""
SRGB_LEVELS = 3
"""Maximum change of a color, in levels of 255, by a profile that counts as sRGB."""
_GAMMA, _PRIMARIES = 0.45455, (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)
_ADOBE_RGB = 2
_HDR = {16: "PQ", 18: "HLG"}
FIX = "Save it as an 8-bit RGB image in sRGB, for instance by `magick IN -colorspace sRGB OUT.png`."


def to_srgb(image: Image.Image, name: str) -> UInt8[np.ndarray, "h w 3"]:
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
        raise InputError(f"{name} has CMYK colors and no color profile for them. {FIX}")
    if why := _other_space(image, info):
        raise InputError(f"{name} has colors that are not sRGB: {why}. {FIX}")
    return np.asarray(image.convert("RGB"))


def hdr_of_png(data: bytes) -> str | None:
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
        raise InputError(f"{name} has a color profile that cannot be used: {error}. {FIX}") from (
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
            return "their primaries are others"
    try:
        exif = image.getexif()
        adobe = exif.get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex) == "R03"
        adobe |= exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.ColorSpace) == _ADOBE_RGB
    except Exception:  # damaged EXIF says nothing, as in every viewer
        return None
    return "EXIF says Adobe RGB" if adobe else None
