"""A tiny training run as a program of its own, so that tests can kill it: DATA OUT STEPS."""

import dataclasses
import sys
from pathlib import Path

import numpy as np

from egosim_jax import configs
from egosim_jax.conditioning.dropout import ConditionDropout
from egosim_jax.data.shards import ShardWriter
from egosim_jax.models.wan_dit import WanDiTConfig
from egosim_jax.train.denoiser import Denoising
from egosim_jax.train.optimizer import OptimizerConfig
from egosim_jax.train.script import Training, train
from egosim_jax.types import VideoSpec

DEBUG = configs.get("debug")
MODEL = dataclasses.replace(
    DEBUG,
    video=VideoSpec(frames=5, height=16, width=32),
    dit=WanDiTConfig(dim=24, ffn_dim=32, heads=2, layers=2, text_dim=64, image_dim=32),
)
TASK = Denoising(model=MODEL, dropout=ConditionDropout(prior=0.2, mask=0.2, hands=0.2, text=0.2))


def training(steps: int, *, seed: int = 0) -> Training:
    """Muon and AdamW's moments, dropout and shuffling: everything that a resume must restore."""
    return Training(
        steps=steps,
        batch_size=2,
        optimizer=OptimizerConfig(rule="muon", learning_rate=1e-2, warmup=2, decay="cosine"),
        seed=seed,
        log_every=1,
        save_every=4,
        validate_every=1000,
    )


def write_latents(folder: Path, records: int = 7) -> None:
    """Shards of random latents in the shapes that `MODEL` is trained on."""
    rng = np.random.default_rng(0)
    shape, size = MODEL.video.latent_shape, MODEL.image.image_size
    with ShardWriter(folder, kind="latents", spec=MODEL.video) as writer:
        for number in range(records):
            latents = {
                name: rng.normal(size=(*shape, 16)).astype(np.float32)
                for name in ("truth", "prior", "hands")
            }
            tokens = MODEL.tokenizer.tokenize([f"take cup {number}"])
            arrays = {
                **latents,
                "mask": rng.integers(0, 2, (*shape, 4)).astype(np.uint8),
                "ids": tokens.ids[0],
                "ids_mask": tokens.mask[0],
                "pixels": rng.normal(size=(size, size, 3)).astype(np.float32),
            }
            writer.add(arrays, {"video_id": f"clip_{number}", "prompt": ""})


if __name__ == "__main__":
    data, out, steps = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    train(TASK, training(steps), data=data, validation=None, out=out)
