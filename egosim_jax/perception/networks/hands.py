"""MediaPipe's hand networks as batched JAX programs, for accelerators.

    LandmarkHands(networks=JaxHandNetworks())

On a CPU, LiteRT is many times as fast, because XLA's depthwise convolutions are slow there. Results
agree to less than a thousandth of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float32, UInt8

from egosim_jax.perception.hands.weights import files
from egosim_jax.perception.networks.tflite import Program, read_program


@dataclass(frozen=True)
class JaxHandNetworks:
    """Palm detector and landmark network (`hands.detect.HandNetworks`), in batches."""

    weights: Path | None = None
    """Folder of the two tflite files; None for those in the user's cache, fetched if need be."""
    offline: bool = False
    """True to refuse instead of fetching weights."""

    @cached_property
    def _networks(self) -> tuple[BatchedNetwork, BatchedNetwork]:
        palms, landmarks = files(self.weights, offline=self.offline)
        return BatchedNetwork(palms), BatchedNetwork(landmarks)

    def palms(
        self, pictures: UInt8[np.ndarray, "b 192 192 3"]
    ) -> tuple[Float32[np.ndarray, "b 2016 18"], Float32[np.ndarray, "b 2016"]]:
        """Return boxes with keypoints relative to the anchors, and logits."""
        boxes, logits = self._networks[0](pictures)
        return boxes, logits[..., 0]

    def landmarks(
        self, pictures: UInt8[np.ndarray, "b 224 224 3"]
    ) -> tuple[
        Float32[np.ndarray, "b 21 3"],
        Float32[np.ndarray, " b"],
        Float32[np.ndarray, " b"],
        Float32[np.ndarray, "b 21 3"],
    ]:
        """Return keypoints in crop pixels, presence, probability of a right hand, and meters."""
        joints, presence, right, meters = self._networks[1](pictures)
        return joints.reshape(-1, 21, 3), presence[:, 0], right[:, 0], meters.reshape(-1, 21, 3)


class BatchedNetwork:
    """Compiled network: weights on the device, one program per power of two of the batch size."""

    def __init__(self, path: Path):
        program = read_program(path)
        self._weights = jax.device_put(program.weights)
        self._run = jax.jit(lambda weights, pictures: _on_pixels(program, weights, pictures))

    def __call__(self, pictures: np.ndarray) -> list[np.ndarray]:
        """Return the outputs for pictures in uint8."""
        padded = np.zeros((1 << (len(pictures) - 1).bit_length(), *pictures.shape[1:]), np.uint8)
        padded[: len(pictures)] = pictures
        results = jax.device_get(self._run(self._weights, padded))
        return [result[: len(pictures)] for result in results]


def _on_pixels(
    program: Program, weights: dict[int, jax.Array], pictures: jax.Array
) -> list[jax.Array]:
    return program(weights, pictures.astype(np.float32) / 255)
