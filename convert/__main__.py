"""`egosim-convert`: foreign checkpoints to ours."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from egosim_jax import command
from egosim_jax.types import InputError

if TYPE_CHECKING:
    import numpy as np

TABLES = {"dit": "wan_dit", "vae": "wan_vae", "text": "umt5", "image": "clip_vision"}
"""Name table of each network of a model."""


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Convert one network from safetensors in foreign names to a file of a weights folder."""

    config: str
    """Name of the model the weights are for."""
    network: Literal["dit", "vae", "text", "image"]
    """Which of its networks."""
    layout: Literal["wan", "diffusers", "transformers"]
    """Whose names: the original Wan and EgoSim release, or the library's."""
    source: Path
    """A .safetensors file, or a folder of them that together hold the network."""
    out: Path
    """Weights folder; <network>.safetensors in it is replaced."""

    def run(self) -> int:
        """Read, translate, check every path and write."""
        from flax import nnx

        from egosim_jax import configs
        from egosim_jax.generator import Networks
        from egosim_jax.io import weights

        config = configs.get(self.config)
        parts = nnx.eval_shape(lambda: Networks(config, rngs=nnx.Rngs(0))).parts()
        if self.network not in parts:
            raise InputError(f"{config.name} has no network {self.network}. (--network)")
        table = importlib.import_module(f"egosim_jax.convert.tables.{TABLES[self.network]}")
        rules = getattr(table, self.layout, None)
        if rules is None:
            raise InputError(f"There is no {self.layout} layout of {self.network}. (--layout)")
        shape = getattr(config, self.network)
        ours = weights.translate(
            self._read(), rules(shape), ignore=table.ignored(shape), source=str(self.source)
        )
        weights.fill(parts[self.network], ours, source=str(self.source))
        target = self.out / f"{self.network}.safetensors"
        weights.save(target, parts[self.network])
        print(f"{len(ours)} arrays", file=sys.stderr)
        print(target)
        return command.DONE

    def _read(self) -> dict[str, np.ndarray]:
        from safetensors.numpy import load_file

        files = sorted(self.source.glob("*.safetensors")) if self.source.is_dir() else [self.source]
        if not files or not all(file.is_file() for file in files):
            raise InputError(f"No safetensors at {self.source}. (--source)")
        return {name: tensor for file in files for name, tensor in load_file(file).items()}


Commands = Annotated[Weights, tyro.conf.subcommand("weights")] | Annotated[None, tyro.conf.Suppress]


def main(args: Sequence[str] | None = None) -> int:
    """Run `egosim-convert`."""
    return command.main(
        Annotated[Weights, tyro.conf.subcommand("weights")],
        program="egosim-convert",
        description="Weights in and out.",
        args=args,
    )


if __name__ == "__main__":
    sys.exit(main())
