"""MediaPipe's hand networks: weights from a pinned wheel, run by LiteRT.

The license of the weights (Apache-2.0) is stored with them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from egosim_jax.io.bounded import quote_path
from egosim_jax.io.wheels import WheelFiles, check_files, fetch_wheel_files
from egosim_jax.types import InputError

PALMS, LANDMARKS = "palm_detection_full.tflite", "hand_landmark_full.tflite"
MEDIAPIPE = WheelFiles(
    name="hands",
    requirement="mediapipe==0.10.14",
    sha256="a807328339e7356fda0bb14df12fedbf1d33bdf81649c5f8666b0026b1cc30b4",
    about="palm detection and hand landmarks of MediaPipe, Apache-2.0",
    tags=(
        "--implementation=cp",
        "--python-version=3.11",
        "--abi=cp311",
        "--platform=manylinux_2_17_x86_64",
    ),
    files={
        "mediapipe/modules/palm_detection/palm_detection_full.tflite": (
            "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54"
        ),
        "mediapipe/modules/hand_landmark/hand_landmark_full.tflite": (
            "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3"
        ),
        "mediapipe-0.10.14.dist-info/LICENSE": (
            "8707eef0533987efc5b155d64761eeb6e20793f50b9bd1a68dad1cf4719d0ed8"
        ),
    },
)
"""The two networks and their license."""


def fetch_weights(folder: Path | None = None, *, offline: bool = False) -> tuple[Path, Path]:
    """Return the verified files of the palm detector and the landmark network.

    They are in `folder`, or in the user's cache if None. The first use downloads them to the cache.
    """
    if folder is None:
        folder = fetch_wheel_files(MEDIAPIPE, offline=offline)
    else:
        check_files(MEDIAPIPE, folder)
    return folder / PALMS, folder / LANDMARKS


class HandNetworks:
    """Palm detector and landmark network on the CPU, for one image at a time."""

    def __init__(self, palms: Path, landmarks: Path, *, threads: int):
        self._palms = _load(palms, threads)
        self._landmarks = _load(landmarks, threads)

    def palms(
        self, image: UInt8[np.ndarray, "192 192 3"]
    ) -> tuple[Float32[np.ndarray, "2016 18"], Float32[np.ndarray, " 2016"]]:
        """Return boxes with keypoints relative to the anchors, and logits."""
        boxes, logits = _run(self._palms, image)
        return boxes, logits[:, 0]

    def landmarks(
        self, image: UInt8[np.ndarray, "224 224 3"]
    ) -> tuple[Float32[np.ndarray, "21 3"], float, float, Float32[np.ndarray, "21 3"]]:
        """Return keypoints in crop pixels, presence, probability of a right hand, and meters."""
        joints, presence, right, meters = _run(self._landmarks, image)
        return joints.reshape(21, 3), presence.item(), right.item(), meters.reshape(21, 3)


def _load(path: Path, threads: int) -> Any:
    """Return LiteRT's interpreter for a model file."""
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ModuleNotFoundError as error:
        raise InputError(
            "Hands cannot be estimated: LiteRT is not installed. The extra `video` has it: "
            "pip install 'egosim-jax[video]'."
        ) from error
    try:
        interpreter = Interpreter(str(path), num_threads=threads)
        interpreter.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise InputError(f"{quote_path(path)} is not a model that LiteRT can run.") from error
    return interpreter


def _run(interpreter: Any, image: np.ndarray) -> list[np.ndarray]:
    """Return the model's outputs for a uint8 image, in order."""
    inputs, outputs = interpreter.get_input_details(), interpreter.get_output_details()
    interpreter.set_tensor(inputs[0]["index"], image[None].astype(np.float32) / 255)
    interpreter.invoke()
    return [interpreter.get_tensor(output["index"])[0] for output in outputs]
