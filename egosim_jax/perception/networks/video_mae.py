"""VideoMAE: features of videos for a Fréchet video distance (FVD).

The original FVD uses I3D, which is distributed as TorchScript; this package runs no downloaded
programs. Checkpoints: MCG-NJU/videomae-base-finetuned-kinetics and -large-finetuned-kinetics (CC
BY-NC 4.0); only the encoder is used. Distances from different networks are not comparable. Source:
Tong et al., VideoMAE, 2022; Ge et al., On the Content Bias in Fréchet Video Distance, 2024.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float32

from egosim_jax.io.bounded import read_json
from egosim_jax.perception.networks.checkpoint import Network, load_network
from egosim_jax.perception.networks.pixels import normalize, resize_levels, to_images
from egosim_jax.perception.networks.worker import Run
from egosim_jax.types.arrays import Video

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet, for checkpoints without a processor file."""


@dataclass(frozen=True)
class VideoMae(Network):
    """Features of videos by VideoMAE's encoder."""

    needs: ClassVar[str] = "VideoMAE (MCG-NJU/videomae-*)"
    model_types: ClassVar[tuple[str, ...]] = ("videomae",)

    def __call__(self, frames: Video) -> Float32[np.ndarray, " d"]:
        """Return the mean feature of the tubes of evenly spaced frames."""
        reply, _ = self.ask({"frames": frames})
        return reply["features"]


def load(folder: str, device: str, dtype: str) -> Run:
    """Load the encoder in a worker."""
    import torch
    from transformers import VideoMAEModel

    network = load_network(VideoMAEModel, folder, device, dtype)
    size = network.config.image_size
    sides = (size, size) if isinstance(size, int) else tuple(size)
    mean, std = _statistics(Path(folder))

    def run(arrays: Mapping[str, np.ndarray], options: Mapping[str, Any]):
        frames = arrays["frames"]
        count = network.config.num_frames
        chosen = np.linspace(0, len(frames) - 1, count).round().astype(int)
        images = normalize(
            resize_levels(to_images(frames[chosen], network.device), sides), mean, std
        )
        with torch.inference_mode():
            output = network(images[None].to(network.dtype)).last_hidden_state
        return {"features": output[0].float().mean(dim=0).cpu().numpy()}, None

    return run


def _statistics(folder: Path) -> tuple[Sequence[float], Sequence[float]]:
    """Return the mean and standard deviation of a checkpoint's training colors."""
    path = folder / "preprocessor_config.json"
    settings = read_json(path) if path.is_file() else {}
    return settings.get("image_mean") or MEAN, settings.get("image_std") or STD
