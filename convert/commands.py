"""What `egosim-convert` does."""

from __future__ import annotations

import importlib
import math
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from egosim_jax import command
from egosim_jax.convert.layouts import Found, Network, recognise
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from flax import nnx

    from egosim_jax.convert.rules import Leaf
    from egosim_jax.generator import ModelConfig

TABLES = {"dit": "wan_dit", "vae": "wan_vae", "text": "umt5", "image": "clip_vision"}
"""Name table of each network of a model."""


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """Say what a checkpoint, or a folder of them, holds, and which configs it fits.

    Reads headers alone.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """A .safetensors or .pth file, or a folder."""
    tensors: bool = False
    """List every tensor, too: name, shape and dtype."""

    def run(self) -> int:
        """Recognise, match with the configs, print."""
        from rich.console import Console
        from rich.table import Table

        folder = recognise(self.source)
        table = Table("network", "names of", "checkpoint", "weights", "dtype", "GB", "fits")
        for found in folder.found:
            tensors = found.tensors.values()
            dtypes = sorted({tensor.dtype.name for tensor in tensors})
            table.add_row(
                found.network,
                found.naming + (f", after {found.prefix!r}" if found.prefix else ""),
                f"{found.source.name} ({len(found.source.files)} files)",
                f"{sum(math.prod(tensor.shape) for tensor in tensors):,}",
                ", ".join(dtypes),
                f"{found.source.bytes / 1e9:.2f}",
                ", ".join(_fitting(found)) or "no config",
            )
        console = Console(width=160)
        console.print(table)
        missing = [name for name in TABLES if name not in {f.network for f in folder.found}]
        for source in folder.unknown:
            console.print(f"{source.name}: no network of ours ({len(source.tensors)} tensors)")
        console.print(f"missing networks: {', '.join(missing) or 'none'}")
        console.print(f"tokenizer: {folder.tokenizer or 'none'}")
        if self.tensors:
            for source in (*(f.source for f in folder.found), *folder.unknown):
                for name, tensor in source.tensors.items():
                    print(f"{name}  {list(tensor.shape)}  {tensor.dtype.name}")
        return command.DONE


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Convert every network that a checkpoint folder holds to a weights folder of a config.

    All names and shapes are checked before anything is written. An interrupted conversion goes on
    where it stopped when the same command is run again.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """A .safetensors or .pth file, or a folder of them as released."""
    config: str
    """Name of the model that the weights are for."""
    out: Path
    """Weights folder; what it has of other networks stays."""
    only: tuple[Network, ...] = ()
    """Convert these networks alone."""
    dtype: Literal["float32", "bfloat16", "float16"] | None = None
    """Store floating weights as this; by default each keeps its own."""

    def run(self) -> int:
        """Recognise, check, write."""
        from egosim_jax import configs

        config = configs.get(self.config)
        folder = recognise(self.source)
        names = self.only or tuple(dict.fromkeys(found.network for found in folder.found))
        if not names:
            raise InputError(f"{self.source} holds no network of ours. (egosim-convert inspect)")
        planned = [(found, plan(found, config)) for found in map(folder.network, names)]
        for found, leaves in planned:
            self._write(found, leaves)
        if folder.tokenizer is not None and "text" in names and config.tokenizer.kind != "byt5":
            shutil.copytree(folder.tokenizer, self.out / config.tokenizer.kind, dirs_exist_ok=True)
        return command.DONE

    def _write(self, found: Found, leaves: Mapping[str, Leaf]) -> None:
        from egosim_jax.convert.stream import write
        from egosim_jax.progress import track_bytes

        target = self.out / f"{found.network}.safetensors"
        about = {"format": "egosim_jax", "config": self.config, "source": found.source.name}
        pieces = write(
            target,
            leaves,
            found.tensors,
            files=found.source.files,
            dtype=self.dtype,
            about=about,
        )
        total = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves.values())
        for _ in track_bytes(pieces, f"writing {target.name}", total=total):
            pass
        print(target)


def plan(found: Found, config: ModelConfig) -> dict[str, Leaf]:
    """What fills each weight of the config's network; `WeightsError` with all that differs."""
    from egosim_jax.convert.rules import assign
    from egosim_jax.io.weights import flat_shapes

    table, shape = _table(found.network), getattr(config, found.network)
    if shape is None:
        raise InputError(f"{config.name} has no network {found.network}. (--config, --only)")
    return assign(
        found.tensors,
        getattr(table, found.naming)(shape),
        ignore=table.ignored(shape),
        want=flat_shapes(_skeleton(found.network, shape)),
        source=found.source.name,
    )


def _skeleton(network: Network, shape: Any) -> nnx.Module:
    """The network without weights."""
    from flax import nnx

    from egosim_jax.models.clip_vision import CLIPVision
    from egosim_jax.models.umt5 import UMT5
    from egosim_jax.models.wan_dit import WanDiT
    from egosim_jax.models.wan_vae import WanVAE

    made = {"dit": WanDiT, "vae": WanVAE, "text": UMT5, "image": CLIPVision}[network]
    return nnx.eval_shape(lambda: made(shape, rngs=nnx.Rngs(0)))


def _table(network: Network) -> ModuleType:
    return importlib.import_module(f"egosim_jax.convert.tables.{TABLES[network]}")


def _fitting(found: Found) -> Iterator[str]:
    """The configs whose network the checkpoint fills."""
    from egosim_jax import configs

    for name in configs.names():
        try:
            plan(found, configs.get(name))
        except InputError:
            continue
        yield name
