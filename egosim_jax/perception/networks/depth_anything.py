"""Metric Depth Anything V2: depth in meters from one image.

Checkpoints: depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf and -Outdoor-Small-hf
(Apache-2.0), -Base-hf and -Large-hf (CC BY-NC 4.0). Source: Yang et al., Depth Anything V2, 2024.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np

from egosim_jax.io.bounded import quote, quote_path
from egosim_jax.perception.networks.checkpoint import Network, load_network
from egosim_jax.perception.networks.worker import Run
from egosim_jax.perception.video.estimates import CameraEstimate, DepthEstimate
from egosim_jax.types import InputError
from egosim_jax.types.arrays import Masks, Video


@dataclass(frozen=True)
class DepthAnything(Network):
    """Depth in meters of single images by Depth Anything V2; a `DepthEstimator`."""

    needs: ClassVar[str] = "Depth Anything V2 (depth-anything/Depth-Anything-V2-Metric-*-hf)"
    model_types: ClassVar[tuple[str, ...]] = ("depth_anything",)
    files: ClassVar[tuple[str, ...]] = ("preprocessor_config.json",)

    _: KW_ONLY
    batch: int = 4
    """Batch size of the network."""

    def check_config(self, config: Mapping[str, Any]) -> None:
        """Raise `InputError` unless this is a metric checkpoint of Depth Anything V2."""
        super().check_config(config)
        kind = config.get("depth_estimation_type", "relative")
        if kind != "metric":
            raise InputError(
                f"{quote_path(self.folder)} estimates {quote(kind)} depth: {self.needs} must be a "
                "metric checkpoint. Use one with Metric in its name."
            )

    def __call__(
        self, frames: Video, moving: Masks, estimate: CameraEstimate, wanted: Sequence[int]
    ) -> DepthEstimate:
        """Return depth in meters of the wanted frames. The cameras are not used."""
        reply, _ = self.ask({"frames": frames[np.asarray(wanted, np.int32)]}, batch=self.batch)
        return DepthEstimate.measured(wanted, reply["depth_m"], metric=True)


def load(folder: str, device: str, dtype: str) -> Run:
    """Load the network and its image processor in a worker."""
    import torch
    from transformers import DepthAnythingForDepthEstimation, DPTImageProcessorPil

    network = load_network(DepthAnythingForDepthEstimation, folder, device, dtype)
    processor: Any = DPTImageProcessorPil.from_pretrained(folder, local_files_only=True)

    def run(arrays: Mapping[str, np.ndarray], options: Mapping[str, Any]):
        frames, depth = arrays["frames"], []
        size = frames.shape[1:3]
        for start in range(0, len(frames), options["batch"]):
            images = list(frames[start : start + options["batch"]])
            inputs = processor(images=images, return_tensors="pt")
            with torch.inference_mode():
                output = network(inputs["pixel_values"].to(network.device, network.dtype))
            output.predicted_depth = output.predicted_depth.float()
            maps = processor.post_process_depth_estimation(output, [size] * len(images))
            depth += [one["predicted_depth"].cpu().numpy() for one in maps]
        return {"depth_m": np.stack(depth)}, None

    return run
