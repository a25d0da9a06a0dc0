"""Frames in batches of equal size, sharded over the local devices."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, UInt8

from egosim_jax.types import InputError


class Batches:
    """Batches of the frames of a video; the last batch is padded with copies.

    All batches have one size, a multiple of the number of devices: only one program is compiled,
    and each device gets an equal part.
    """

    def __init__(self, count: int, max_size: int):
        """Divide `count` frames into batches of at most `max_size` frames, or one per device."""
        devices = jax.local_device_count()
        parts = -(-count // max(max_size, devices))
        size = -(-count // parts)
        self._size = -(-size // devices) * devices
        self._count = count

    def of(self, frames: UInt8[np.ndarray, "f h w c"]) -> Iterator[Array]:
        """Yield the batches of a video."""
        for first in range(0, self._count, self._size):
            numbers = np.minimum(np.arange(first, first + self._size), self._count - 1)
            yield jax.device_put(frames[numbers], _sharding())

    def join(self, values: Iterable[Any]) -> np.ndarray:
        """Return the values of all frames, given the values of each batch, without the padding."""
        return np.concatenate([np.asarray(part) for part in values])[: self._count]


@cache
def _sharding() -> NamedSharding:
    mesh = Mesh(np.array(jax.local_devices()), ("frames",))
    return NamedSharding(mesh, PartitionSpec("frames"))


def check_same_shape(
    video: UInt8[np.ndarray, "f h w c"], reference: UInt8[np.ndarray, "g y x c"]
) -> None:
    """Raise `InputError` unless two videos have the same number of frames and the same size."""
    if video.shape != reference.shape:
        raise InputError(
            f"Videos of the shapes {video.shape} and {reference.shape} cannot be compared: frames "
            "and size must be equal. Resize one of them."
        )
