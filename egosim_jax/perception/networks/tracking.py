"""Tracking of objects through a video, from boxes in one frame, by the SAM family.

Checkpoints: yonigozlan/EdgeTAM-hf and facebook/sam2.1-hiera-tiny to -large (Apache-2.0),
facebook/sam3 (SAM license; access on request). Sources: Zhou et al., EdgeTAM, 2025; Ravi et al.,
SAM 2, 2024; Carion et al., SAM 3, 2025.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from egosim_jax.perception.networks.checkpoint import CONFIG, Network, load_network
from egosim_jax.perception.networks.pixels import (
    PixelSettings,
    normalize,
    resize_levels,
    resize_maps,
    to_images,
)
from egosim_jax.perception.networks.worker import Run
from egosim_jax.types import InputError
from egosim_jax.types.arrays import IdMaps, Video

if TYPE_CHECKING:
    import torch

BOX_LABELS = (2, 3)
"""Point prompt labels of a box's first and last corner."""
SAM2_PIXELS = PixelSettings(
    height=1024, width=1024, mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225)
)
SAM3_PIXELS = PixelSettings(height=1008, width=1008, mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Tracker(Network):
    """Tracker of objects from their boxes in one frame."""

    def __call__(self, frames: Video, frame: int, boxes_px: Sequence[Box]) -> IdMaps:
        """Return the box number (from 1) of each pixel's object; 0 for no object.

        The boxes contain the objects in one frame. The objects are tracked forward and backward
        from there.
        """
        reply, _ = self.ask(
            {"frames": frames, "boxes_px": np.asarray(boxes_px, np.float32)}, frame=frame
        )
        return reply["labels"]


@dataclass(frozen=True)
class EdgeTam(Tracker):
    """EdgeTAM, a small tracker."""

    needs: ClassVar[str] = "EdgeTAM (yonigozlan/EdgeTAM-hf)"
    model_types: ClassVar[tuple[str, ...]] = ("edgetam_video",)

    def check_installed(self) -> None:
        """Raise `InputError` with missing packages; its image encoder RepViT needs timm."""
        super().check_installed()
        vision = self._read_config().get("vision_config") or {}
        encoder = (vision.get("backbone_config") or {}).get("model_type")
        if encoder == "timm_wrapper" and find_spec("timm") is None:
            raise InputError(
                f"{self.needs} cannot run: timm must be installed. pip install timm, or use SAM 2 "
                "(--masks grounded-sam2)."
            )


@dataclass(frozen=True)
class Sam2Tracker(Tracker):
    """SAM 2 and 2.1."""

    needs: ClassVar[str] = "SAM 2 (facebook/sam2.1-hiera-tiny)"
    model_types: ClassVar[tuple[str, ...]] = ("sam2_video",)


@dataclass(frozen=True)
class Sam3Tracker(Tracker):
    """SAM 3's tracker, from the checkpoint that also detects objects by text."""

    needs: ClassVar[str] = "SAM 3 (facebook/sam3)"
    model_types: ClassVar[tuple[str, ...]] = ("sam3_video", "sam3_tracker_video")


def load(folder: str, device: str, dtype: str) -> Run:
    """Load the folder's network in a worker."""
    import torch
    import transformers

    kind = json.loads((Path(folder) / CONFIG).read_text())["model_type"]
    name, default = {
        "edgetam_video": ("EdgeTamVideo", SAM2_PIXELS),
        "sam2_video": ("Sam2Video", SAM2_PIXELS),
    }.get(kind, ("Sam3TrackerVideo", SAM3_PIXELS))
    network_type = getattr(transformers, f"{name}Model")
    module = importlib.import_module(network_type.__module__)
    session_type = getattr(module, f"{name}InferenceSession")
    network = load_network(network_type, folder, device, dtype)
    pixels = PixelSettings.read(Path(folder), default)

    def run(arrays: Mapping[str, np.ndarray], options: Mapping[str, Any]):
        frames = arrays["frames"]
        height, width = frames.shape[1:3]
        session = new_session(session_type, network, frames, pixels)
        scale = np.array([pixels.width / width, pixels.height / height] * 2, np.float32)
        for number, box in enumerate(arrays["boxes_px"] * scale, start=1):
            points = torch.from_numpy(box).to(network.device).reshape(1, 1, 2, 2)
            labels = torch.tensor(BOX_LABELS, dtype=torch.int32).to(network.device).reshape(1, 1, 2)
            inputs = {"point_coords": points, "point_labels": labels}
            session.add_point_inputs(session.obj_id_to_idx(number), options["frame"], inputs)
            session.obj_with_new_inputs.append(number)
        labels = np.zeros(frames.shape[:3], np.int32)
        with torch.inference_mode():
            for output in _propagate(network, session, options["frame"]):
                labels[output.frame_idx] = to_labels(output.pred_masks[:, 0], (height, width))
        return {"labels": labels}, None

    return run


def new_session(session: Any, network: Any, frames: np.ndarray, pixels: PixelSettings) -> Any:
    """Return a session of a class of transformers in which a network sees a video."""
    opened = session(
        video_height=frames.shape[1],
        video_width=frames.shape[2],
        inference_device=network.device,
        inference_state_device=network.device,
        dtype=network.dtype,
    )
    opened.processed_frames = PreparedFrames(frames, pixels, network.dtype)
    return opened


def _propagate(network: Any, session: Any, start: int) -> Iterator[Any]:
    """Yield the outputs of all frames: forward from a start frame, then backward."""
    yield from network.propagate_in_video_iterator(session, start_frame_idx=start)
    if start > 0:
        yield from network.propagate_in_video_iterator(session, start_frame_idx=start, reverse=True)


class PreparedFrames:
    """Frames of a video as a network's inputs, each prepared on access."""

    def __init__(self, frames: np.ndarray, pixels: PixelSettings, dtype: torch.dtype):
        """Store the frames `f h w 3`, and the size, statistics and type of the inputs."""
        self._frames, self._pixels, self._dtype = frames, pixels, dtype

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, number: int) -> torch.Tensor:
        pixels = self._pixels
        images = to_images(self._frames[number][None], "cpu")
        images = resize_levels(images, (pixels.height, pixels.width))
        return normalize(images, pixels.mean, pixels.std)[0].to(self._dtype)


def to_labels(logits: torch.Tensor, size: tuple[int, int]) -> np.ndarray:
    """Return the number (from 1) of the mask with the largest positive logit at each pixel."""
    best, index = resize_maps(logits, size).max(dim=0)
    return (((index + 1) * (best > 0)).cpu().numpy()).astype(np.int32)
