"""Weights of MediaPipe's hand networks, out of a pinned wheel.

Their license (Apache-2.0) is kept with them.
"""

from __future__ import annotations

from pathlib import Path

from egosim_jax.io.wheels import WheelFiles, check_files, fetch_wheel_files

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


def files(folder: Path | None = None, *, offline: bool = False) -> tuple[Path, Path]:
    """Return the palm detector's and the landmark network's file, verified.

    They are in `folder` or, if None, in the user's cache, where they are fetched to at first use.
    """
    if folder is None:
        folder = fetch_wheel_files(MEDIAPIPE, offline=offline)
    else:
        check_files(MEDIAPIPE, folder)
    return folder / PALMS, folder / LANDMARKS
