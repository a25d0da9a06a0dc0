"""MediaPipe's hand networks on the CPU, by LiteRT."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from egosim_jax.io.untrusted.bounded import quote_path
from egosim_jax.types import InputError


class LiteRtNetworks:
    """Palm detector and landmark network (`detect.HandNetworks`), one picture at a time."""

    def __init__(self, palms: Path, landmarks: Path, *, threads: int):
        self._palms = _interpreter(palms, threads)
        self._landmarks = _interpreter(landmarks, threads)

    def palms(
        self, pictures: UInt8[np.ndarray, "b 192 192 3"]
    ) -> tuple[Float32[np.ndarray, "b 2016 18"], Float32[np.ndarray, "b 2016"]]:
        """Return boxes with keypoints relative to the anchors, and logits."""
        boxes, logits = _run(self._palms, pictures)
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
        joints, presence, right, meters = _run(self._landmarks, pictures)
        return joints.reshape(-1, 21, 3), presence[:, 0], right[:, 0], meters.reshape(-1, 21, 3)


def _interpreter(path: Path, threads: int) -> Any:
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ModuleNotFoundError as error:
        raise InputError(
            "Hands cannot be estimated: LiteRT is not installed. It is in the extra `video`: "
            "pip install 'egosim-jax[video]'."
        ) from error
    try:
        interpreter = Interpreter(str(path), num_threads=threads)
        interpreter.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise InputError(f"{quote_path(path)} is not a model that LiteRT can run.") from error
    return interpreter


def _run(interpreter: Any, pictures: np.ndarray) -> list[np.ndarray]:
    """Return the outputs for pictures in uint8, in the order of the model's outputs."""
    inputs, outputs = interpreter.get_input_details(), interpreter.get_output_details()
    results: list[list[np.ndarray]] = [[] for _ in outputs]
    for picture in pictures:
        interpreter.set_tensor(inputs[0]["index"], picture[None].astype(np.float32) / 255)
        interpreter.invoke()
        for result, output in zip(results, outputs, strict=True):
            result.append(interpreter.get_tensor(output["index"]))
    return [np.concatenate(result) for result in results]
