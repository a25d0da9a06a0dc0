"""Depth Pro: sharp depth in meters and the focal length from one image.

Checkpoint: apple/DepthPro-hf, under Apple's research license (non-commercial). The network
estimates inverse depth for a focal length of one image width. A known focal length scales it to
meters, or else the network's own field of view. Source: Bochkovskii et al., Depth Pro, 2024,
section 3.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from egosim_jax.perception.networks.checkpoint import Network, load_network
from egosim_jax.perception.networks.pixels import PixelSettings, normalize, resize_maps, to_images
from egosim_jax.perception.networks.worker import Run
from egosim_jax.perception.video.estimates import CameraEstimate, DepthEstimate
from egosim_jax.types import InputError
from egosim_jax.types.arrays import Masks, Video

FIELD_OF_VIEW_DEG = (10.0, 150.0)
"""Minimum and maximum plausible horizontal field of view in degrees."""
INVERSE_DEPTH = (1e-4, 1e4)
"""Minimum and maximum inverse depth in 1/m."""
DEFAULT = PixelSettings(height=1536, width=1536, mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))


@dataclass(frozen=True)
class DepthPro(Network):
    """Depth in meters and focal length from single images by Depth Pro; a `DepthEstimator`."""

    needs: ClassVar[str] = "Depth Pro (apple/DepthPro-hf)"
    model_types: ClassVar[tuple[str, ...]] = ("depth_pro",)

    def check_config(self, config: Mapping[str, Any]) -> None:
        """Raise `InputError` unless the checkpoint estimates the field of view."""
        super().check_config(config)
        if not config.get("use_fov_model"):
            raise InputError(
                f"{self.folder} estimates no field of view (use_fov_model): {self.needs} must "
                "estimate it. Use the checkpoint as released."
            )

    def __call__(
        self, frames: Video, moving: Masks, estimate: CameraEstimate, wanted: Sequence[int]
    ) -> DepthEstimate:
        """Return depth in meters of the wanted frames, for the cameras' focal length if known.

        Raises `InputError` if it is unknown and the estimated one is implausible.
        """
        inverse, fields_of_view_deg = self._estimate(frames[np.asarray(wanted, np.int32)])
        width = frames.shape[2]
        if estimate.cameras is not None:
            focal_px = float(estimate.cameras.intrinsics_px[0, 0])
        else:
            focal_px = focal_of(fields_of_view_deg, width)
        depth_m = 1 / np.clip(inverse * (width / focal_px), *INVERSE_DEPTH)
        return DepthEstimate.measured(wanted, depth_m, metric=True)

    def focal_px(self, frames: Video) -> float:
        """Return the focal length of a video in pixels, from the median over its frames."""
        return focal_of(self._estimate(frames)[1], frames.shape[2])

    def _estimate(
        self, frames: Video
    ) -> tuple[Float[np.ndarray, "f h w"], Float[np.ndarray, " f"]]:
        reply, _ = self.ask({"frames": frames})
        return reply["inverse_depth"], reply["field_of_view_deg"]


def focal_of(fields_of_view_deg: Float[np.ndarray, " f"], width: int) -> float:
    """Return the focal length in pixels of the median horizontal field of view.

    Raises `InputError` if it is implausible.
    """
    median = float(np.median(fields_of_view_deg))
    low, high = FIELD_OF_VIEW_DEG
    if not low <= median <= high:
        raise InputError(
            f"The estimated field of view is {median:.4g} degrees: it must be from {low:g} to "
            f"{high:g}. Give the focal length. (--focal)"
        )
    return 0.5 * width / float(np.tan(0.5 * np.radians(median)))


def load(folder: str, device: str, dtype: str) -> Run:
    """Load the network in a worker."""
    import torch
    from torch.nn.functional import interpolate
    from transformers import DepthProForDepthEstimation

    network = load_network(DepthProForDepthEstimation, folder, device, dtype)
    settings = PixelSettings.read(Path(folder), DEFAULT)
    size = settings.height, settings.width

    def run(arrays: Mapping[str, np.ndarray], options: Mapping[str, Any]):
        inverse, fields = [], []
        for frame in arrays["frames"]:
            images = normalize(to_images(frame[None], network.device), settings.mean, settings.std)
            images = interpolate(images, size=size, mode="bilinear", align_corners=False)
            with torch.inference_mode():
                output = network(images.to(network.dtype))
            maps = resize_maps(output.predicted_depth, frame.shape[:2])
            inverse.append(maps[0].cpu().numpy())
            fields.append(output.field_of_view.float().cpu().numpy()[0])
        return {"inverse_depth": np.stack(inverse), "field_of_view_deg": np.array(fields)}, None

    return run
