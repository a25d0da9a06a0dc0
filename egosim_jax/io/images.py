"""Read images as uint8 RGB arrays, and depth maps, checked before they are decoded.

Every image of a user is opened here. An image is read as viewers show it: turned as EXIF says, in
sRGB. Cameras of a reconstruction (COLMAP, nerfstudio) are of the pixels as they are stored; its
readers ask for `pixels="stored"`.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, Shaped, UInt8
from PIL import ExifTags, Image, UnidentifiedImageError

from egosim_jax.io.bounded import quote_path, quote_text, read_bytes, refusing
from egosim_jax.io.colors import FIX, hdr_of_png, to_srgb
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

    Colors are sRGB (`io/colors.py`). The upper 8 of 16 bits are kept.
    """
    with refusing(f"{name} is not a readable image"):
        with _open(data, name, IMAGES) as image:
            if image.mode in ("I", "F"):
                raise InputError(f"{name} has 32 bits a channel; save it with 8 or 16.")
            if image.format == "PNG":
                image.verify()  # checks the CRC of every chunk and consumes the file: open it again
        if hdr := hdr_of_png(data):
            raise InputError(f"{name} is HDR ({hdr}), which is not read. {FIX}")
        with _open(data, name, IMAGES) as image:
            turn = _orientation(image)
            image.load()
            if pixels == "shown":
                _check_square(image, name)
            colors = to_srgb(image, name)
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
