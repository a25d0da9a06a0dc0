"""Subcommands of `egosim convert`."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from egosim_jax.convert.detect import DetectedNetwork, detect, known_tables
from egosim_jax.convert.plan import fits, network_config, to_jax, to_torch, widening_of
from egosim_jax.convert.source import tokenizer_files
from egosim_jax.convert.tables import pipeline_files, table_of
from egosim_jax.convert.widen import WidenMode
from egosim_jax.convert.writer import (
    Weight,
    apart,
    in_memory,
    write_file,
    write_sharded,
)
from egosim_jax.io.atomic import atomic_folder, lock_folder
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.mapped import OURS
from egosim_jax.io.run import write_json
from egosim_jax.io.weights import add_others, check_not_in_8_bits, hashes
from egosim_jax.runtime import command
from egosim_jax.runtime.terminal import make_console, printable
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.models import NetworkConfig
    from egosim_jax.models.lora import Change

Dtype = Literal["float32", "bfloat16", "float16"]
"""Floating dtypes that weights can be cast to."""


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """List the networks of a checkpoint file or folder, and the configs that each network fits.

    Reads only headers.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """File in .safetensors or .pth format, or folder."""
    tensors: bool = False
    """Also list name, shape and dtype of every tensor."""

    def run(self) -> int:
        """Detect the networks, match them with the configs, print."""
        from rich.table import Table

        from egosim_jax import configs

        folder = detect(self.source)
        table = Table("network", "naming", "checkpoint", "weights", "dtype", "GB", "fits")
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
                ", ".join(n for n in configs.names() if fits(found, configs.get(n))) or "none",
            )
        console = make_console(width=160)
        console.print(table)
        names = dict.fromkeys(name for name, _ in known_tables())
        missing = [name for name in names if name not in {f.network for f in folder.found}]
        for source in folder.unknown:
            console.print(f"{source.name}: no known network ({len(source.tensors)} tensors)")
        console.print(f"missing networks: {', '.join(missing) or 'none'}")
        console.print(f"tokenizer: {quote_path(folder.tokenizer or 'none')}")
        if self.tensors:
            for source in (*(f.source for f in folder.found), *folder.unknown):
                for name, tensor in source.tensors.items():
                    print(printable(f"{name}  {list(tensor.shape)}  {tensor.dtype.name}"))
        return command.ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Convert every network of a checkpoint folder to a weights folder of a config.

    Networks that the config lacks are skipped with a message. A folder without one that the config
    needs is refused, unless --only names the others or it is in --out. All names and shapes are
    checked before anything is written, and all values are checked to be finite. Running the same
    command again resumes an interrupted conversion.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """File in .safetensors or .pth format, or folder of them as released."""
    config: str
    """Name of the model that the weights are for."""
    out: Path
    """Weights folder; its other networks are kept."""
    only: tuple[str, ...] = ()
    """Convert only these networks: dit, vae, text, image."""
    prefix: str | None = None
    """Text before the names, such as `ema`, if a file has several checkpoints of a network."""
    dtype: Dtype | None = None
    """Dtype to store floating weights in; by default each keeps its own."""
    widen: WidenMode | None = None
    """Convert a base model with fewer input channels; the kernels of the new ones are 0.

    `polarity` converts the base's mask (Wan: 1 = keep) to the model's; `copy` assumes that both
    are equal."""

    def plan(self) -> tuple[list[tuple[DetectedNetwork, list[Weight]]], dict[str, bytes], str]:
        """Return networks and their weights, files of the tokenizer, and names of other networks.

        Only headers are read. Raises `InputError` if the checkpoint cannot be converted.
        """
        from egosim_jax import configs

        config = configs.get(self.config)
        folder = detect(self.source, config).only(self.prefix)
        detected = dict.fromkeys(found.network for found in folder.found)
        names = self.only or tuple(name for name in detected if name in config.networks)
        needless = ", ".join(name for name in detected if name not in config.networks)
        if not names:
            has = f"only {needless}, which {self.config} lacks" if needless else "no known network"
            raise InputError(f"{quote_path(self.source)} holds {has}. (egosim convert inspect)")
        apart(self.out, self.source)
        planned = []
        for found in map(folder.network, names):
            widening = widening_of(config, found.network, self.widen)
            weights = to_jax(found, config, dtype=self.dtype, widening=widening)
            planned.append((found, weights))
            for file in found.source.files:
                apart(self.out / f"{found.network}.safetensors", file)
        if not self.only:
            folder.check_complete(config, names, out=self.out)
        kept = {}
        if folder.tokenizer is not None and "text" in names and config.tokenizer.kind != "byt5":
            kept = tokenizer_files(folder.tokenizer, within=self.source)
        return planned, kept, needless

    def run(self) -> int:
        """Detect, check and write the networks."""
        from egosim_jax import configs
        from egosim_jax.configs.model import metadata_of

        config = configs.get(self.config)
        planned, kept, needless = self.plan()
        if needless and not self.only:
            print(f"skipped, as {self.config} lacks it: {needless}", file=sys.stderr)
        with lock_folder(self.out):
            for found, weights in planned:
                if found.low_rank:
                    print(
                        f"{found.source.name}: skipped {len(found.low_rank)} tensors of a LoRA on "
                        "its layers. Merge it with `egosim convert lora --merge`.",
                        file=sys.stderr,
                    )
                target = self.out / f"{found.network}.safetensors"
                metadata = {"format": OURS, "config": self.config, "source": found.source.name}
                metadata |= metadata_of(found.network, config.chunks)
                origin, settings = found.source.files, (self.prefix, self.widen)
                write_file(target, weights, origin=origin, metadata=metadata, settings=settings)
            if kept:
                with atomic_folder(self.out / config.tokenizer.kind) as temporary:
                    for name, data in kept.items():
                        (temporary / name).write_bytes(data)
        return command.ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class ToTorch:
    """Write a weights folder as safetensors that PyTorch projects load.

    `wan` is the layout of the Wan and EgoSim releases. `diffusers` has a folder per network, with
    the configs that `from_pretrained` reads; the caller passes the tokenizer. A network above 5 GB
    becomes several files with an index.
    """

    weights: Annotated[Path, tyro.conf.Positional]
    """Weights folder to convert."""
    config: str
    """Name of the model."""
    out: Path
    """Folder to write to."""
    layout: str = "wan"
    """Layout of names and files: wan, diffusers, or another of the model's tables."""
    only: tuple[str, ...] = ()
    """Write only these networks: dit, vae, text, image."""
    dtype: Dtype | None = None
    """Dtype to store floating weights in; by default each keeps its own."""

    def run(self) -> int:
        """Check, convert and write the weights."""
        from egosim_jax import configs
        from egosim_jax.io.mapped import read_safetensors

        config = configs.get(self.config)
        apart(self.out, self.weights)
        _check_not_in_8_bits(self.weights, self.only or tuple(config.networks))
        planned = []
        for name in self.only or tuple(config.networks):
            network = network_config(config, name)
            table, file = table_of(network), self.weights / f"{name}.safetensors"
            naming = table.naming_in(self.layout)
            tensors = read_safetensors(file)
            converted = to_torch(tensors, network, naming, dtype=self.dtype, source=file.name)
            files = table.namings[naming]
            planned.append((name, self.out / files.folder / files.stem, file, converted))
        pipeline = {}
        if self.layout == "diffusers":
            pipeline = pipeline_files(config, [name for name, *_ in planned])
        with lock_folder(self.out):
            for _, stem, file, converted in planned:
                write_sharded(stem, converted, origin=[file])
            for path, content in pipeline.items():
                write_json(self.out / path, content)
        return command.ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class Lora:
    """Convert a LoRA for ComfyUI and diffusers, or merge it into weights.

    Reads the namings of PEFT, diffusers, kohya (VideoX-Fun, musubi) and ComfyUI, with alpha, after
    any prefix. A setting that changes the meaning is applied or refused.
    """

    writes: ClassVar[command.Writes] = "file"
    source: Annotated[Path, tyro.conf.Positional]
    """LoRA file, or its folder with PEFT's config or with full weights (DWM)."""
    config: str
    """Name of the LoRA's model."""
    out: Path
    """File to write; with --merge, a weights folder with the other networks of that one."""
    merge: Path | None = None
    """Weights folder to merge the LoRA into."""
    scale: Annotated[float, tyro.conf.arg(aliases=["--lora-scale"])] = 1.0
    """Strength of the LoRA in a merge."""
    base: Path | None = None
    """Weights folder that the LoRA was trained on; the file's header gets its hash."""
    prefix: str | None = None
    """Text before the names, such as `ema`, if the file has several LoRAs."""
    adapter: str | None = None
    """Name of PEFT's adapter, if the file has several."""
    layout: Literal["dwm", "egosim"] | None = None
    """Layout instead of ComfyUI's names; `egosim` is ours, for `egosim train --lora`.

    `dwm` writes a folder like DWM's checkpoints. It has a LoRA in the names of PEFT or, on Wan, of
    VideoX-Fun, and the patch projection."""

    def run(self) -> int:
        """Read, check and write the LoRA."""
        from egosim_jax import configs
        from egosim_jax.convert.lora import base_of, check_base, read_lora
        from egosim_jax.models import lora

        config = configs.get(self.config).dit
        lora.check_scale(self.scale)
        if self.layout and self.merge is not None:
            raise InputError(
                f"--merge and --layout {self.layout} exclude each other: merged weights are in our "
                "layout. Omit one of them."
            )
        for source in (self.source, self.merge):
            if source is not None:
                apart(self.out, source)
        if self.merge is not None:
            _check_not_in_8_bits(self.merge, ["dit"])
        base = {_hash(folder) for folder in (self.merge, self.base) if folder is not None}
        if base:
            check_base(self.source, base)
        changes = read_lora(self.source, config, prefix=self.prefix, adapter=self.adapter)
        origin = [self.source]
        if self.source.is_dir():
            origin = sorted(file for file in self.source.iterdir() if file.is_file())
        files = self._files(changes, config, next(iter(base), None) or base_of(self.source))
        settings = (self.prefix, self.adapter, self.scale)
        with lock_folder(next(iter(files)).parent):
            for file, (weights, metadata) in files.items():
                used = origin if self.merge is None else [self.merge / file.name, *origin]
                write_file(file, weights, origin=used, metadata=metadata, settings=settings)
            if self.merge is not None:
                add_others(self.out, self.merge)
        return command.ExitCode.DONE

    def _files(
        self, changes: Mapping[str, Change], config: NetworkConfig, base: str | None
    ) -> dict[Path, tuple[Sequence[Weight], Mapping[str, str]]]:
        """Return weights and metadata of the files to write; `base` is the hash of their base."""
        from egosim_jax import configs
        from egosim_jax.configs.model import metadata_of
        from egosim_jax.convert.lora_export import checkpoint, exported, exported_metadata
        from egosim_jax.convert.plan import merged
        from egosim_jax.io.mapped import read_safetensors
        from egosim_jax.models import lora

        trained_on = {} if base is None else {lora.BASE: base}
        ours = {"format": OURS, "config": self.config}
        ours |= metadata_of("dit", configs.get(self.config).chunks)
        if self.merge is not None:
            before = read_safetensors(self.merge / "dit.safetensors")
            weights = merged(before, changes, config, scale=self.scale)
            metadata = ours | {"lora": quote_path(self.source.name)}
            return {self.out / "dit.safetensors": (weights, metadata)}
        if self.layout == "dwm":
            before = None if self.base is None else read_safetensors(self.base / "dit.safetensors")
            metadata = {"format": "pt"} | trained_on
            return {
                self.out / f"{stem}.safetensors": (in_memory(tensors), metadata)
                for stem, tensors in checkpoint(changes, config, before).items()
            }
        if self.layout is None:
            weights, metadata = in_memory(exported(changes, config)), exported_metadata(changes)
            return {self.out: (weights, metadata | trained_on)}
        if base is None:
            raise InputError(
                f"{quote_path(self.source)} does not say which weights it was trained on: give "
                "them. (--base)"
            )
        return {self.out: (in_memory(lora.tensors(changes)), ours | trained_on)}


def _check_not_in_8_bits(folder: Path, networks: Sequence[str]) -> None:
    """Raise `InputError` if a network of a weights folder is in 8 bits."""
    use = "cannot be converted further"
    check_not_in_8_bits(folder, networks, use=use, fix="Give the weights that they were made of.")


def _hash(folder: Path) -> str:
    """Return the hash of the denoiser in a weights folder."""
    found = hashes(folder, only=("dit",))
    if not found:
        raise InputError(f"{quote_path(folder)} has no dit.safetensors. (--merge, --base)")
    return found["dit"]
