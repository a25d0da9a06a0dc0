"""A tiny training run as a program, so that tests can kill it: DATA OUT STEPS SAVE_EVERY."""

import dataclasses
import sys
from pathlib import Path

import numpy as np

from egosim_jax import configs
from egosim_jax.command import DONE, run_with_exit_codes
from egosim_jax.conditioning.dropout import ConditionDropout
from egosim_jax.data.shards import ShardWriter
from egosim_jax.io import weights
from egosim_jax.models.wan.config import WanDiTConfig
from egosim_jax.train.config import OptimizerConfig, TrainConfig
from egosim_jax.train.distributed import distributed_context
from egosim_jax.train.loop import train
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.types import VideoSpec

DEBUG = configs.get("debug")
MODEL = dataclasses.replace(
    DEBUG,
    video=VideoSpec(frames=5, height=16, width=32),
    encoders="frozen",
    dit=WanDiTConfig(dim=24, ffn_dim=32, heads=2, layers=2, text_dim=64, image_dim=32),
)
TASK = Denoising(model=MODEL, dropout=ConditionDropout(prior=0.2, mask=0.2, hands=0.2, text=0.2))


def training(steps: int, save_every: int) -> TrainConfig:
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
    )


def write_latents(folder: Path, records: int = 7) -> None:
    """Shards of random latents in the shapes that `MODEL` is trained on."""
    rng = np.random.default_rng(0)
    shape, dit = MODEL.latent_shape, MODEL.dit
    with ShardWriter(folder, kind="latents", spec=MODEL.video) as writer:
        for number in range(records):
            arrays = {
                "mask": rng.integers(0, 2, (*shape, 4)).astype(np.uint8),
                "text": rng.normal(size=(7, dit.text_dim)).astype(np.float32),
                "image": rng.normal(size=(5, dit.image_dim)).astype(np.float32),
            }
            for name in ("target", "prior", "hands"):
                arrays[name] = rng.normal(size=(*shape, 16)).astype(np.float32)
            writer.add(arrays, {"video_id": f"clip_{number}", "prompt": ""})


def main(data: str, out: str, steps: str, save_every: str) -> int:
    """Train, and write the weights."""

    def run() -> int:
        with distributed_context():
            schedule = training(int(steps), int(save_every))
            networks = train(TASK, schedule, data=Path(data), validation=None, out=Path(out))
            weights.save(Path(out) / "dit.safetensors", networks.dit)
        return DONE

    return run_with_exit_codes(run)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
