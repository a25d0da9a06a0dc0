"""Settings of an online training, and its position, which checkpoints keep."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from egosim_jax import configs
from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.configs.model import ModelConfig
from egosim_jax.io.weights import check_trainable
from egosim_jax.train.tasks.few_steps import FewSteps
from egosim_jax.train.tasks.refining import Refining
from egosim_jax.types import InputError, check_counts


@dataclass(frozen=True, kw_only=True)
class OnlineTraining:
    """Settings of an online training."""

    config: str = "tabletop"
    """Name of the model to train."""
    weights: Path | None = None
    """Folder of the weights to start from, by default the package's."""
    out: Path
    """Folder of the run."""
    minutes: float | None = 12.0
    """Duration, compilation included; None: by `updates`."""
    updates: int | None = None
    """Number of the denoiser's updates; the run ends at the first of both limits."""
    workers: int = 14
    """Number of processes that make scenes; 0: train on the given latents only."""
    first_scene: int = 2_000_000
    """Seed of the first scene."""
    held_out: int = 48
    """Number of validation scenes, of the seeds from 0."""
    latents: Path | None = None
    """Folder of latents made beforehand, which may still grow (`latents.py`)."""
    batch: int = 128
    """Clips of a denoiser's update."""
    per_program: int = 8
    """Updates of the denoiser in one program."""
    learning_rate: float = 1.2e-3
    """Peak learning rate of the denoiser."""
    weight_decay: float = 0.05
    """Its weight decay."""
    ema_decay: float = 0.9995
    """Decay of its moving average."""
    decoder_share: float = 0.25
    """Share of the device's time for the decoder; 0: the decoder stays."""
    decoder_batch: int = 6
    """Clips of a decoder's update."""
    decoder_rate: float = 1e-3
    """Peak learning rate of the decoder."""
    decoder_ema: float = 0.998
    """Decay of its moving average."""
    generated: float = 0.5
    """Fraction of the decoder's latents that the denoiser generated, from a third of the run on."""
    first_clips: int = 64
    """Clips that must be there before the first update.

    A denoiser that begins with few clips learns them by heart and does not recover in minutes."""
    clips: int = 12288
    """Capacity of the pool of latents."""
    frames: int = 3072
    """Capacity of the pool of frames."""
    seed: int = 0
    """Seed of the batches and the noise."""
    log_s: float = 10.0
    """Seconds between log lines."""
    validate_s: float = 75.0
    """Seconds between validations."""
    save_s: float = 120.0
    """Seconds between writings of the weights."""

    def __post_init__(self) -> None:
        if self.minutes is None and self.updates is None:
            raise InputError("A training needs an end: give minutes or updates. (--minutes)")
        _ = self.start
        counts = ("batch", "per_program", "decoder_batch", "first_clips", "clips", "frames")
        check_counts({name: getattr(self, name) for name in counts})

    @cached_property
    def model(self) -> ModelConfig:
        """Config of the model, with the numerics of this training."""
        import jax

        model = configs.get(self.config)
        dit: Any = replace(model.dit, remat="none")
        if jax.default_backend() == "gpu":  # cuDNN's kernel has a backward pass, "auto" has none
            dit = replace(dit, dtype="bfloat16", products=None, attention="cudnn")
        return replace(model, dit=dit)

    @property
    def start(self) -> Path:
        """Folder of the weights to start from. Raises `InputError` without any, or in 8 bits."""
        folder = configs.weights_of(self.config, self.weights)
        check_trainable(folder)
        return folder

    @property
    def denoising(self) -> FewSteps:
        """Task of the denoiser."""
        dropout = ConditionDropout(prior=0.05, mask=0.05, hands=0.05, text=0.05)
        return FewSteps(model=self.model, dropout=dropout, change_loss_weight=4.0)

    @property
    def refining(self) -> Refining:
        """Task of the decoder."""
        return Refining(
            vae=self.model.vae,
            video=self.model.video,
            crop=(self.model.video.height, self.model.video.width),
            part="decoder",
            motion_weight=4.0,
        )


@dataclass(kw_only=True)
class Progress:
    """Counters of an online training, kept over interruptions."""

    seconds: float = 0.0
    """Seconds that the run had taken when this was last saved."""
    first: float | None = None
    """Second of the first update."""
    done: int = 0
    """Finished updates of the denoiser."""
    skipped: int = 0
    """Updates of the denoiser that were skipped because loss or gradient were not finite."""
    decoded: int = 0
    """Finished updates of the decoder."""
    decoder_first: float | None = None
    """Share of the run at the decoder's first update."""
    pace: int | None = None
    """Updates of the decoder next to one program of the denoiser's."""
    arrived: int = 0
    """Clips that the processes have made, so that they continue with other scenes."""

    def get_state(self) -> Mapping[str, Any]:
        """Return the counters as JSON."""
        return asdict(self)

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Set the counters to saved ones."""
        for name, value in state.items():
            setattr(self, name, value)
