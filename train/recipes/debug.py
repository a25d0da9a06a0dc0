"""The smallest training there is, on clips of the tabletop world: to see that everything runs.

    egosim-train debug --out runs/debug

takes minutes on 2 CPU cores.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from egosim_jax.train.config import OptimizerConfig, Recipe, Training
from egosim_jax.train.distributed import check_alone
from egosim_jax.train.recipes.real_tiny import RealTiny
from egosim_jax.train.update import Stage

CLIP_FRAMES, STRIDE = 25, 8
"""Of a clip, three windows of 9 frames to train on and two to test on."""


def _training(steps: int) -> Training:
    return Training(
        steps=steps,
        batch_size=2,
        optimizer=OptimizerConfig(rule="muon", learning_rate=3e-3, warmup=5),
        log_every=5,
        save_every=10,
        validate_every=20,
    )


@dataclass(frozen=True, kw_only=True)
class Debug(Recipe):
    """Train `debug` for a few steps on a few clips of the tabletop world."""

    out: Path
    """Folder of the run."""
    clips: int = 8
    """Clips to make; every fourth is for testing."""
    vae: Training = field(default_factory=lambda: _training(20))
    """Training of the autoencoder."""
    denoiser: Training = field(default_factory=lambda: _training(20))
    """Training of the denoiser and its encoders."""
    weights: Path | None = None
    """Weights folder to start from: its autoencoder stays, its denoiser is trained further."""

    @property
    def metadata(self) -> Path:
        """The clips, as files."""
        return self.out / "clips" / "metadata.csv"

    def stages(self) -> Mapping[str, Stage]:
        """Those of `real_tiny`."""
        return self._real_tiny().stages()

    def train(self) -> int:
        """Make the clips, then do as `real_tiny` does."""
        from egosim_jax import configs
        from egosim_jax.data.clips import write_clips
        from egosim_jax.io.atomic import hold_folder
        from egosim_jax.worlds.tabletop import make_sequence, to_triplet

        check_alone("debug")
        hold_folder(self.out)
        spec = replace(configs.get("debug").video, frames=CLIP_FRAMES)
        if not self.metadata.exists():
            made = (to_triplet(next(make_sequence(seed, spec=spec))) for seed in range(self.clips))
            splits = ({"split": "test" if n % 4 == 3 else "train"} for n in range(self.clips))
            clips = (replace(clip, extra=extra) for clip, extra in zip(made, splits, strict=True))
            write_clips(self.metadata.parent, clips, fps=spec.fps)
        return self._real_tiny().train()

    def _real_tiny(self) -> RealTiny:
        return RealTiny(
            metadata=self.metadata,
            out=self.out,
            config="debug",
            clip_frames=CLIP_FRAMES,
            stride=STRIDE,
            vae=self.vae,
            denoiser=self.denoiser,
            weights=self.weights,
        )
