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
            _read(self.source), rules(shape), ignore=table.ignored(shape), source=str(self.source)
        )
        weights.fill(parts[self.network], ours, source=str(self.source))
        target = self.out / f"{self.network}.safetensors"
        weights.save(target, parts[self.network])
        print(f"{len(ours)} arrays", file=sys.stderr)
        print(target)
        return command.DONE


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """List the tensors of safetensors: name, shape and dtype, and how many weights in all."""

    source: Path
    """A .safetensors file, or a folder of them."""

    def run(self) -> int:
        """Read the headers alone."""
        from math import prod

        from safetensors import safe_open

        weights = 0
        for file in _files(self.source):
            with safe_open(file, framework="numpy") as tensors:
                for name in tensors.keys():  # noqa: SIM118  (not a mapping)
                    tensor = tensors.get_slice(name)
                    weights += prod(tensor.get_shape())
                    print(f"{name}  {tensor.get_shape()}  {tensor.get_dtype()}")
        print(f"{weights:,} weights", file=sys.stderr)
        return command.DONE


def _files(source: Path) -> list[Path]:
    files = sorted(source.glob("*.safetensors")) if source.is_dir() else [source]
    if not files or not all(file.is_file() for file in files):
        raise InputError(f"No safetensors at {source}. (--source)")
    return files


def _read(source: Path) -> dict[str, np.ndarray]:
    from safetensors.numpy import load_file

    return {name: tensor for file in _files(source) for name, tensor in load_file(file).items()}


Commands = (
    Annotated[Weights, tyro.conf.subcommand("weights")]
    | Annotated[Inspect, tyro.conf.subcommand("inspect")]
)


def main(args: Sequence[str] | None = None) -> int:
    """Run `egosim-convert`."""
    return command.main(
        Commands,
        program="egosim-convert",
        description="Weights in and out.",
        args=args,
    )


if __name__ == "__main__":
    sys.exit(main())
