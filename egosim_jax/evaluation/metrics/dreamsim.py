"""DreamSim (Fu et al. 2023): distance between images, by the package `dreamsim`.

The package runs the ensemble of its release v0.2.0-checkpoints in PyTorch: an image is resized to
224 x 224 (bicubic) and embedded by DINO, CLIP and OpenCLIP with a LoRA. The embeddings are
concatenated and centered; the distance is one minus their cosine.

The package unpickles the weights by torch (`weights_only`) and gets DINO's code from GitHub unless
the folder has it.
"""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.io.bounded import quote_path
from egosim_jax.io.digest import sha256
from egosim_jax.types import InputError

SIZE_PX = 224
"""Height and width of the input of the networks."""
DEFINITION = (
    f"DreamSim, ensemble of release v0.2.0: frames resized to {SIZE_PX}x{SIZE_PX}, bicubic; one "
    "minus the cosine of the centered embeddings of DINO, CLIP and OpenCLIP; per frame, mean over "
    "frames; less is closer"
)
MISSING = (
    "its weights are not part of any package: unpack the release v0.2.0-checkpoints of "
    "ssundaram21/dreamsim (dreamsim_ensemble_checkpoint.zip) and give its folder. (--dreamsim)"
)
FILES = (
    "dino_vitb16_pretrain.pth",
    "clip_vitb16_pretrain.pth.tar",
    "open_clip_vitb16_pretrain.pth.tar",
    "ensemble_lora/adapter_config.json",
)
"""Files of the release, in its folder."""
MAX_FRAMES = 8
"""Maximum number of frames that are embedded together."""


class DreamSim:
    """DreamSim distance between frames."""

    def __init__(self, folder: Path):
        """Load the networks. Raises `InputError` without the package or a file of the release."""
        missing = [name for name in FILES if not (folder / name).is_file()]
        if missing:
            raise InputError(
                f"{quote_path(folder)} has no {', '.join(missing)}: DreamSim's ensemble needs "
                "them. Unpack dreamsim_ensemble_checkpoint.zip of its release "
                "v0.2.0-checkpoints there. (--dreamsim)"
            )
        if find_spec("dreamsim") is None:
            raise InputError(
                "DreamSim is computed by the package dreamsim, which is not installed: "
                "pip install dreamsim. (--dreamsim)"
            )
        import torch

        load = import_module("dreamsim").dreamsim
        self._device = "cuda" if torch.cuda.is_available() else "cpu"
        with redirect_stdout(sys.stderr):
            self._network, self._prepare = load(cache_dir=str(folder), device=self._device)
        adapters = sorted((folder / "ensemble_lora").glob("adapter_model.*"))
        files = [*(folder / name for name in FILES), *adapters]
        self.hashes = {path.name: sha256(path) for path in files}
        """SHA-256 of the weight files, by name."""

    def embed(self, frames: UInt8[np.ndarray, "f h w 3"]) -> Float[np.ndarray, "f d"]:
        """Return the centered embedding of each frame."""
        import torch
        from PIL import Image

        images = torch.cat([self._prepare(Image.fromarray(frame)) for frame in frames])
        with torch.inference_mode():
            embedded = [
                self._network.embed(batch.to(self._device)) for batch in images.split(MAX_FRAMES)
            ]
        return torch.cat(embedded).cpu().numpy()

    def distances(
        self, a: Float[np.ndarray, "f d"], b: Float[np.ndarray, "f d"]
    ) -> Float[np.ndarray, " f"]:
        """Return the distance of each pair of embeddings."""
        norms = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
        return 1 - (a * b).sum(axis=1) / norms
