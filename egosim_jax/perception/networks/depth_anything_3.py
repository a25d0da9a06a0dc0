"""Depth Anything 3: consistent depth and cameras of many views.

Checkpoints: depth-anything/DA3-SMALL and DA3-BASE (Apache-2.0), DA3-LARGE, DA3-GIANT and
DA3NESTED-GIANT-LARGE-1.1 (CC BY-NC 4.0). Only the last one is metric. Its package requires an old
NumPy, so it is installed without its dependencies (docs/networks.md). Source: Lin et al., Depth
Anything 3, 2025.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np

from egosim_jax.geometry import invert
from egosim_jax.io.bounded import quote, quote_path
from egosim_jax.perception.networks.checkpoint import Network, check_device
from egosim_jax.perception.networks.pixels import resize_maps
from egosim_jax.perception.networks.worker import Run
from egosim_jax.perception.video.cameras.path import complete_path
from egosim_jax.perception.video.depth.triangulate import triangulate_frames
from egosim_jax.perception.video.estimates import CameraEstimate, DepthEstimate, Verdict
from egosim_jax.types import Cameras, InputError, is_rigid
from egosim_jax.types.arrays import Masks, Video

MIN_VIEWS = 2
"""Minimum number of views for alignment with given cameras."""


@dataclass(frozen=True)
class _DepthAnything3(Network):
    """Shared settings of depth and cameras by Depth Anything 3."""

    needs: ClassVar[str] = "Depth Anything 3 (depth-anything/DA3*)"
    packages: ClassVar[tuple[str, ...]] = ("torch", "torchvision", "depth_anything_3")
    install: ClassVar[str] = (
        "pip install 'egosim-jax[networks]', then the packages that docs/networks.md lists, then "
        "pip install --no-deps depth-anything-3"
    )

    _: KW_ONLY
    resolution_px: int = 504
    """Longer side of the network's input images in pixels."""

    def check_config(self, config: Mapping[str, Any]) -> None:
        """Raise `InputError` unless the config names a model of Depth Anything 3."""
        name = config.get("model_name")
        if not (isinstance(name, str) and name.startswith("da3")):
            name_given = quote(config.get("model_type", name))
            raise InputError(
                f"{quote_path(self.folder)} is a checkpoint of {name_given}: {self.needs} needs a "
                "config.json with a model_name such as da3nested-giant-large. Give its folder."
            )


@dataclass(frozen=True)
class DepthAnything3(_DepthAnything3):
    """Multi-view depth by Depth Anything 3; a `DepthEstimator`."""

    _: KW_ONLY
    context: int = 8
    """Number of evenly spaced frames that the network sees besides the wanted ones."""

    def __call__(
        self, frames: Video, moving: Masks, estimate: CameraEstimate, wanted: Sequence[int]
    ) -> DepthEstimate:
        """Return depth of the wanted frames, in the unit of the cameras if they move.

        If the cameras are unknown or stay in place, depth is in the network's unit, which is the
        meter for a metric checkpoint.
        """
        chosen = np.asarray(wanted, np.int32)
        context = np.linspace(0, len(frames) - 1, min(self.context, len(frames))).astype(int)
        views = np.unique([*chosen, *context])
        arrays = {"frames": frames[views]}
        aligned = estimate.cameras is not None and _moves(estimate, views)
        if estimate.cameras is not None and aligned:
            poses = estimate.cameras.world_from_camera[views]
            arrays["extrinsics"] = invert(poses).astype(np.float32)
            matrix = estimate.cameras.intrinsics_px.astype(np.float32)
            arrays["intrinsics"] = np.repeat(matrix[None], len(views), axis=0)
        reply, about = self.ask(arrays, resolution_px=self.resolution_px)
        depth = reply["depth"][np.searchsorted(views, chosen)]
        metric = estimate.metric if aligned else bool(about["metric"])
        return DepthEstimate.measured(wanted, depth, metric=metric)


@dataclass(frozen=True)
class DepthAnything3Cameras(_DepthAnything3):
    """Cameras by Depth Anything 3; a `CameraEstimator`.

    The network always returns cameras. They are accepted if corners of the first frame, tracked
    by optical flow, triangulate in them with a small reprojection error.
    """

    _: KW_ONLY
    max_views: int = 61
    """Maximum number of input frames, evenly spaced; other poses are interpolated."""
    min_points: int = 50
    """Minimum number of corners with parallax."""
    max_error_px: float = 2.0
    """Maximum median reprojection error of the corners in pixels."""

    def __call__(
        self, frames: Video, moving: Masks, *, focal_px: float | None = None
    ) -> CameraEstimate:
        """Return cameras and points, in meters for a metric checkpoint, or a refusal.

        `focal_px` is not used: the network estimates the focal length.
        """
        count, height, width = frames.shape[:3]
        views = np.unique(np.linspace(0, count - 1, min(self.max_views, count)).astype(int))
        reply, about = self.ask({"frames": frames[views]}, resolution_px=self.resolution_px)
        if "extrinsics" not in reply:
            raise InputError(
                f"{quote_path(self.folder)} gives depth alone: cameras need a multi-view "
                "checkpoint. Use one such as DA3-BASE. (--cameras)"
            )
        poses = np.repeat(np.eye(4)[None], len(views), axis=0)
        poses[:, :3] = reply["extrinsics"][:, :3]
        if not is_rigid(poses).all():
            return _refused("the network's poses are not rigid transforms", {})
        cameras = Cameras(
            world_from_camera=complete_path(views, poses[0] @ invert(poses), count),
            intrinsics_px=np.median(reply["intrinsics"], axis=0).astype(float),
            height=height,
            width=width,
        )
        points = triangulate_frames(frames, moving, cameras, [0])
        number = 0 if points is None else len(points.points_m)
        error_px = float("nan") if points is None else float(np.median(points.error_px))
        figures = {"network_points": float(number), "network_error_px": error_px}
        if number < self.min_points:
            reason = f"{number} corners show parallax in the network's cameras: too few to judge"
            return _refused(reason, {"network_points": float(number)})
        if error_px > self.max_error_px:
            reason = f"followed corners miss the network's cameras by {error_px:.1f} pixels"
            return _refused(f"{reason}, above {self.max_error_px:g}", figures)
        reason = f"{number} followed corners meet at an error of {error_px:.2f} pixels"
        verdict = Verdict(rung="network", reason=reason, figures=figures)
        metric = bool(about["metric"])
        return CameraEstimate(cameras=cameras, metric=metric, verdict=verdict, points=points)


def _refused(reason: str, figures: Mapping[str, float]) -> CameraEstimate:
    verdict = Verdict(rung="refused", reason=reason, figures=figures)
    return CameraEstimate(cameras=None, metric=False, verdict=verdict)


def _moves(estimate: CameraEstimate, views: np.ndarray) -> bool:
    """Return True if the cameras of some views are at different places."""
    if estimate.cameras is None or len(views) < MIN_VIEWS:
        return False
    centers = estimate.cameras.world_from_camera[views, :3, 3]
    return bool(np.ptp(centers, axis=0).max() > 1e-6)


def load(folder: str, device: str, dtype: str) -> Run:
    """Load the network in a worker. Its package chooses the precision."""
    import torch

    program = importlib.import_module("depth_anything_3.api").DepthAnything3
    network = program.from_pretrained(folder, local_files_only=True, strict=True)
    network = network.to(check_device(device)).eval()

    def run(arrays: Mapping[str, np.ndarray], options: Mapping[str, Any]):
        size = arrays["frames"].shape[1:3]
        prediction = network.inference(
            list(arrays["frames"]),
            extrinsics=arrays.get("extrinsics"),
            intrinsics=arrays.get("intrinsics"),
            process_res=options["resolution_px"],
        )
        maps = torch.from_numpy(np.asarray(prediction.depth, np.float32))
        reply = {"depth": resize_maps(maps, size).numpy()}
        if prediction.extrinsics is not None and prediction.intrinsics is not None:
            intrinsics = np.array(prediction.intrinsics, float)  # of the network's input images
            scale = np.array(size[::-1]) / np.asarray(prediction.depth).shape[:0:-1]
            intrinsics[:, :2] *= scale[:, None]
            intrinsics[:, :2, 2] += (scale - 1) / 2
            reply |= {
                "extrinsics": np.asarray(prediction.extrinsics, float),
                "intrinsics": intrinsics,
            }
        return reply, {"metric": bool(prediction.is_metric)}

    return run
