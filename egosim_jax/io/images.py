"""Read images as uint8 RGB arrays, and depth maps, checked before they are decoded."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from egosim_jax.io.bounded import quote_path, quote_text, read_bytes, refusing
from egosim_jax.io.untrusted.npz import read_npy
from egosim_jax.types import InputError

MAX_IMAGE_PIXELS = 2**25
"""Maximum number of pixels of one image or frame: 8192 x 4096."""
MAX_IMAGE_BYTES = 2**28
"""Maximum size of an image file in bytes."""
IMAGES = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "PPM")
"""Image formats that can be read."""


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as RGB. Raises `InputError` if it is missing, damaged or too large."""
    return decode_image(read_bytes(path, limit=MAX_IMAGE_BYTES), name=quote_path(path))


def decode_image(data: bytes, *, name: str = "the encoded image") -> UInt8[np.ndarray, "h w 3"]:
    """Decode the bytes of an image file (`read_image`); `name` replaces the path in errors.

    The upper 8 of 16 bits are kept.
    """
    with refusing(f"{name} is not a readable image"):
        with Image.open(io.BytesIO(data), formats=IMAGES) as image:
            if image.width * image.height > MAX_IMAGE_PIXELS:
                raise InputError(
                    f"{name} has {image.width}x{image.height} pixels, more than "
                    f"{MAX_IMAGE_PIXELS:,}, the maximum."
                )
            if image.mode in ("I", "F"):
                raise InputError(f"{name} has 32 bits a channel; save it with 8 or 16.")
            if image.format == "PNG":
                image.verify()  # checks the CRC of every chunk and consumes the file: open it again
        with Image.open(io.BytesIO(data), formats=IMAGES) as image:
            if image.mode.startswith("I;16"):
                gray = (np.asarray(image) >> 8).astype(np.uint8)
                return np.stack([gray] * 3, axis=-1)
            return np.asarray(image.convert("RGB"))


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
