"""Steps that the experiments with trainings share: make clips, train a denoiser.

Each step loads its result if it exists: an interrupted experiment resumes.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from egosim_jax.experiments.config import Hyperparameters
from egosim_jax.runtime.progress import track
from egosim_jax.train import loop
from egosim_jax.train.config import OptimizerConfig, TrainConfig
from egosim_jax.train.fine_tuning import write_trained
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.types import VideoGrid
from egosim_jax.worlds.tabletop.dataset import DatasetConfig, make_shards


def make_frames(config: DatasetConfig, out: Path, *, grid: VideoGrid) -> Path:
    """Make the clips of a split; return the folder of their shards."""
    scenes = make_shards(config, out=out, workers=os.cpu_count() or 1, grid=grid)
    for _ in track(scenes, f"making {out.name}", total=len(config.seeds)):
        pass
    return out


def train_config(stage: Hyperparameters) -> TrainConfig:
    """Return training settings with eight validations and a checkpoint at least every 50 updates.

    Raises `InputError` for invalid values.
    """
    every = max(1, stage.steps // 8)
    return TrainConfig(
        steps=stage.steps,
        batch_size=stage.batch_size,
        optimizer=OptimizerConfig(
            name=stage.optimizer,
            learning_rate=stage.learning_rate,
            warmup_steps=stage.warmup,
            schedule="cosine",
        ),
        seed=stage.seed,
        save_every=min(every, 50),
        validate_every=every,
    )


def train_denoiser(
    task: Denoising,
    stage: Hyperparameters,
    *,
    data: Path,
    validation: Path,
    out: Path,
    start: Path | None,
    others: Callable[[], Path],
) -> Path:
    """Train a denoiser; return its weights folder, or the file of its LoRA.

    `start` has the initial weights; None for random ones. Without it, `others` returns the folder
    of the networks that are not trained.
    """
    done = out / ("weights" if task.rank is None else "lora.safetensors")
    # Untrained networks, such as the autoencoder, are linked last: they mark a complete folder.
    if done.is_file() or (done / "vae.safetensors").exists():
        return done
    trained = loop.train(
        task, train_config(stage), data=data, validation=validation, out=out, weights=start
    )
    return write_trained(trained, out, model=task.model, start=start or others(), rank=task.rank)
