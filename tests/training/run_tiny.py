"""A tiny training run as a program, so that tests can kill it.

DATA OUT STEPS SAVE_EVERY [TASK [CONTEXT]]
"""

import dataclasses
import sys
from pathlib import Path

from egosim_jax import configs
from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.io import weights
from egosim_jax.models.chunks import Chunks
from egosim_jax.runtime.command import ExitCode, run_with_exit_codes
from egosim_jax.testing import tiny_model
from egosim_jax.train.config import CriticConfig, OptimizerConfig, TrainConfig
from egosim_jax.train.distributed import training_context
from egosim_jax.train.loop import train
from egosim_jax.train.tasks.consistency import Consistency
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.train.tasks.matching import Matching
from egosim_jax.types import MeshConfig, VideoSpec

MODEL = tiny_model()
DROPOUT = ConditionDropout(prior=0.2, mask=0.2, hands=0.2, text=0.2)
SMALL = configs.get("dwm_tabletop")
DWM = dataclasses.replace(
    SMALL,
    video=VideoSpec(frames=9, height=32, width=64, fps=8),
    dit=dataclasses.replace(SMALL.dit, dim=64, heads=4, layers=2, time_dim=16),
    vae=dataclasses.replace(SMALL.vae, dims=(4, 4, 8, 8), groups=2),
    tokenizer=dataclasses.replace(SMALL.tokenizer, max_tokens=8),
    posterior="sampled",
)
"""A tiny `dwm_tabletop` with all random draws of DWM's training."""
STUDENT = dataclasses.replace(MODEL, chunks=Chunks(sizes=(1, 1)), steps=2)
TASKS = {
    "egosim": Denoising(model=MODEL, dropout=DROPOUT),
    "dwm": Denoising(model=DWM, dropout=DROPOUT, navigation=0.3),
    "student_cd": Consistency(model=STUDENT, points=4),
    "student_dmd": Matching(
        model=STUDENT, training=CriticConfig(updates=2, optimizer=OptimizerConfig())
    ),
}


def training(steps: int, save_every: int, *, context: int = 1) -> TrainConfig:
    """Return a config with Muon's and AdamW's moments and an EMA, which a resume must restore."""
    return TrainConfig(
        steps=steps,
        batch_size=2,
        optimizer=OptimizerConfig(
            name="muon",
            learning_rate=1e-2,
            warmup_steps=2,
            schedule="cosine",
            ema_decay=0.9,
        ),
        log_every=1,
        save_every=save_every,
        validate_every=1000,
        mesh=MeshConfig(context=context),
    )


def fit(data: Path, out: Path, *, steps: int, save_every: int, task: str, context: int = 1) -> None:
    """Train, and write the weights."""
    config = training(steps, save_every, context=context)
    networks = train(TASKS[task], config, data=data, validation=None, out=out)
    weights.save(out / "dit.safetensors", networks.dit)


def main(
    data: str, out: str, steps: str, save_every: str, task: str = "egosim", context: str = "1"
) -> int:
    """Train as the commands do."""
    counts = {"steps": int(steps), "save_every": int(save_every), "context": int(context)}

    def run() -> int:
        with training_context():
            fit(Path(data), Path(out), task=task, **counts)
        return ExitCode.DONE

    return run_with_exit_codes(run)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
