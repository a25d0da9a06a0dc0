"""X-CLIP: similarity of a video to a text.

Checkpoints: microsoft/xclip-base-patch32 and its variants (MIT). A few evenly spaced frames are
resized by their shorter side, center-cropped and normalized, as in the checkpoint's
preprocessor_config.json. Source: Ni et al., Expanding Language-Image Pretrained Models
for General Video Recognition, 2022.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from PIL import Image

from egosim_jax.io.bounded import read_json
from egosim_jax.perception.networks.checkpoint import Network, load_network
from egosim_jax.perception.networks.worker import Run
from egosim_jax.types.arrays import Video

PREPROCESSOR = "preprocessor_config.json"
MEAN, STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
"""Mean and standard deviation of CLIP's training images, if a checkpoint has no values."""


@dataclass(frozen=True)
class XClip(Network):
    """Similarity of videos to texts by X-CLIP."""

    needs: ClassVar[str] = "X-CLIP (microsoft/xclip-base-patch32)"
    model_types: ClassVar[tuple[str, ...]] = ("xclip",)
    files: ClassVar[tuple[str, ...]] = (PREPROCESSOR, "tokenizer_config.json")

    def __call__(self, video: Video, text: str) -> float:
        """Return the cosine similarity of a video and a text, from -1 to 1."""
        reply, _ = self.ask({"video": video}, text=text)
        return float(reply["similarity"])


def load(folder: str, device: str, dtype: str) -> Run:
    """Load the network and its tokenizer in a worker."""
    import torch
    from transformers import CLIPTokenizer, XCLIPModel

    network = load_network(XCLIPModel, folder, device, dtype)
    tokenizer: Any = CLIPTokenizer.from_pretrained(folder, local_files_only=True)
    settings = read_json(Path(folder) / PREPROCESSOR)
    vision = network.config.vision_config
    mean, std = (
        settings.get(name, default) for name, default in (("image_mean", MEAN), ("image_std", STD))
    )

    def run(arrays: Mapping[str, np.ndarray], options: Mapping[str, Any]):
        pixels = prepare(
            arrays["video"], frames=vision.num_frames, size=vision.image_size, mean=mean, std=std
        )
        tokens = tokenizer([options["text"]], truncation=True, return_tensors="pt").to(
            network.device
        )
        pixels = torch.from_numpy(pixels)[None].to(network.device, network.dtype)
        with torch.inference_mode():
            output = network(pixel_values=pixels, **tokens)
            similarity = output.logits_per_video[0, 0] / network.logit_scale.exp()
        return {"similarity": similarity.float().cpu().numpy()}, None

    return run


def prepare(
    video: Video, *, frames: int, size: int, mean: Any, std: Any
) -> Float[np.ndarray, "n 3 {size} {size}"]:
    """Return evenly spaced frames of a video as the network's input: normalized center crops."""
    chosen = np.linspace(0, len(video) - 1, frames).round().astype(int)
    height, width = video.shape[1:3]
    scale = size / min(height, width)
    rows, columns = max(size, round(scale * height)), max(size, round(scale * width))
    top, left = (rows - size) // 2, (columns - size) // 2
    squares = [
        np.asarray(Image.fromarray(video[n]).resize((columns, rows), Image.Resampling.BICUBIC))
        for n in chosen
    ]
    cropped = np.stack(squares)[:, top : top + size, left : left + size] / 255
    normalized = (cropped - np.asarray(mean)) / np.asarray(std)
    return normalized.transpose(0, 3, 1, 2).astype(np.float32)
