"""A line fitted to points: a task that compiles quickly, to test the loop around any task.

As a program: OUT, DATA and JSON of `TrainConfig` fields; reading never ends at record `hang`, and
`validates` on DATA.
"""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from egosim_jax.data.shards import ShardWriter
from egosim_jax.models.layers import Linear
from egosim_jax.runtime import preemption
from egosim_jax.runtime.command import ExitCode, run_with_exit_codes
from egosim_jax.train.config import OptimizerConfig, TrainConfig
from egosim_jax.train.distributed import training_context
from egosim_jax.train.loop import train
from egosim_jax.types import MeshConfig

WIDTH, POINTS = 8, 40


@dataclass(frozen=True)
class Line:
    """Squared error of `x @ kernel + bias`; `ids` identifies the records of a batch in order."""

    pause: float = 0.0
    hang: int = -1
    """Number of the record at which reading never ends."""
    frozen_dtype: str = "float32"
    trained: Any = nnx.Param

    def networks(self, rngs: nnx.Rngs) -> Linear:
        return Linear(4, WIDTH, axes=(None, "embed"), rngs=rngs)

    def examples(self):
        def read(arrays):
            time.sleep(1e6 if arrays["number"].item() == self.hang else self.pause)
            return arrays

        return read if self.pause or self.hang >= 0 else None

    def shapes(self, batch):
        sizes = {"x": (4,), "y": (WIDTH,), "number": (), "record": ()}
        dtypes = {"number": np.int32, "record": np.int32}
        return {
            name: jax.ShapeDtypeStruct((batch, *size), dtypes.get(name, np.float32))
            for name, size in sizes.items()
        }

    def keys(self, key, batch):
        return jax.random.split(key, batch)

    def loss(self, networks, batch, keys):
        noise = jax.vmap(lambda key: jax.random.normal(key, (4,)))(keys)
        error = networks(batch["x"] + 0.01 * noise) - batch["y"]
        places = jnp.arange(1.0, len(batch["record"]) + 1)
        return jnp.square(error).mean(), {"ids": (places * batch["record"]).mean()}

    def validate(self, networks, batch):
        return {"loss": jnp.square(networks(batch["x"]) - batch["y"]).mean(axis=-1)}

    def flops(self, samples):
        return 6.0 * 4 * WIDTH * samples


def write_points(
    folder: Path,
    *,
    huge: tuple[int, ...] = (),
    factor: float = 1e30,
    unreadable: tuple[int, ...] = (),
) -> Path:
    """Write noisy points of a line; `huge` ones are far from it, `unreadable` ones are NaN."""
    rng = np.random.default_rng(0)
    kernel = rng.normal(size=(4, WIDTH))
    with ShardWriter(folder, kind="latents") as writer:
        for number in range(POINTS):
            x = rng.normal(size=4).astype(np.float32)
            x = x * np.float32("nan") if number in unreadable else x
            y = (x @ kernel + 0.1 * rng.normal(size=WIDTH)).astype(np.float32)
            y = y * np.float32(factor) if number in huge else y
            arrays = {"x": x, "y": y, "number": np.array(number, np.int32)}
            writer.add(arrays, {"video_id": f"point_{number}"})
    return folder


def training(**changes: Any) -> TrainConfig:
    """A short run that saves often."""
    optimizer = OptimizerConfig(learning_rate=0.05, **changes.pop("optimizer", {}))
    fields = {"steps": 20, "batch_size": 8, "log_every": 1, "save_every": 5, "validate_every": 100}
    return TrainConfig(**{**fields, "optimizer": optimizer, **changes})


def main(out: str, data: str, changes: str) -> int:
    """Train as the commands do."""
    settings = json.loads(changes)
    settings["mesh"] = MeshConfig(**settings.pop("mesh", {}))
    validation = Path(data) if settings.pop("validates", False) else None
    task = Line(pause=settings.pop("pause", 0.0), hang=settings.pop("hang", -1))

    def run() -> int:
        preemption.expect()
        with training_context():
            config = training(**settings)
            train(task, config, data=Path(data), validation=validation, out=Path(out))
        return ExitCode.DONE

    return run_with_exit_codes(run)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
