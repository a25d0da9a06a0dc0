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
from egosim_jax.convert.widen import Widening, WidenMode
from egosim_jax.convert.writer import (
    Weight,
    apart,
    in_memory,
    in_rows,
    write_file,
    write_sharded,
)
from egosim_jax.io.atomic import atomic_folder, lock_folder
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.mapped import OURS, Tensor
from egosim_jax.io.run import write_json
from egosim_jax.io.weights import WeightsError, hashes, link_others, mismatches
from egosim_jax.runtime import command
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import make_console, printable
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig
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

    def run(self, *, keep_logs: bool = False) -> int:
        """Detect, check and write the networks; with `keep_logs`, only incomplete ones."""
        from egosim_jax import configs
        from egosim_jax.configs.model import metadata_of

        config = configs.get(self.config)
        folder = detect(self.source, config).only(self.prefix)
        detected = dict.fromkeys(found.network for found in folder.found)
        names = self.only or tuple(name for name in detected if name in config.networks)
        needless = ", ".join(name for name in detected if name not in config.networks)
        if not names:
            has = f"only {needless}, which {self.config} lacks" if needless else "no known network"
            raise InputError(f"{quote_path(self.source)} holds {has}. (egosim convert inspect)")
        if needless and not self.only:
            print(f"skipped, as {self.config} lacks it: {needless}", file=sys.stderr)
        apart(self.out, self.source)
        planned = []
        for found in map(folder.network, names):
            widening = _widening(found, config, self.widen)
            weights = to_jax(found, config, dtype=self.dtype, widening=widening)
            planned.append((found, weights))
            if found.low_rank:
                print(
                    f"{found.source.name}: skipped {len(found.low_rank)} tensors of a LoRA on its "
                    "layers. Merge it with `egosim convert lora --merge`.",
                    file=sys.stderr,
                )
            for file in found.source.files:
                apart(self.out / f"{found.network}.safetensors", file)
        if not self.only:
            folder.check_complete(config, names, out=self.out)
        kept = {}
        if folder.tokenizer is not None and "text" in names and config.tokenizer.kind != "byt5":
            kept = tokenizer_files(folder.tokenizer, within=self.source)
        with lock_folder(self.out):
            for found, weights in planned:
                target = self.out / f"{found.network}.safetensors"
                metadata = {"format": OURS, "config": self.config, "source": found.source.name}
                metadata |= metadata_of(found.network, config.chunks)
                origin = found.source.files
                write_file(target, weights, origin=origin, metadata=metadata, keep_log=keep_logs)
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
    """File to write; with --merge, a weights folder whose other networks are symlinks."""
    merge: Path | None = None
    """Weights folder to merge the LoRA into."""
    scale: float = 1.0
    """Strength of the LoRA in a merge."""
    base: Path | None = None
    """Weights folder that the LoRA was trained on; the file's header gets its hash."""
    prefix: str | None = None
    """Text before the names, such as `ema`, if the file has several LoRAs."""
    adapter: str | None = None
    """Name of PEFT's adapter, if the file has several."""
    layout: Literal["dwm"] | None = None
    """Layout instead of one file; `dwm` writes a folder like DWM's checkpoints.

    It has a LoRA in the names of PEFT or, on Wan, of VideoX-Fun, and the patch projection."""

    def run(self) -> int:
        """Read, check and write the LoRA."""
        from egosim_jax import configs
        from egosim_jax.configs.model import metadata_of
        from egosim_jax.convert.lora import base_of, check_base, read_lora
        from egosim_jax.convert.lora_export import exported, exported_metadata
        from egosim_jax.convert.plan import merged
        from egosim_jax.io.mapped import read_safetensors
        from egosim_jax.models.lora import BASE, check_scale

        config = configs.get(self.config).dit
        check_scale(self.scale)
        for source in (self.source, self.merge):
            if source is not None:
                apart(self.out, source)
        base = {_hash(folder) for folder in (self.merge, self.base) if folder is not None}
        if base:
            check_base(self.source, base)
        changes = read_lora(self.source, config, prefix=self.prefix, adapter=self.adapter)
        origin = [self.source]
        if self.source.is_dir():
            origin = sorted(file for file in self.source.iterdir() if file.is_file())
        known = next(iter(base), None) or base_of(self.source)
        trained_on = {} if known is None else {BASE: known}
        if self.layout == "dwm":
            return self._write_checkpoint(changes, config, origin, trained_on)
        if self.merge is None:
            metadata = exported_metadata(changes) | trained_on
            weights = in_memory(exported(changes, config))
            with lock_folder(self.out.parent):
                write_file(self.out, weights, origin=origin, metadata=metadata)
            return command.ExitCode.DONE
        file = self.merge / "dit.safetensors"
        weights = merged(read_safetensors(file), changes, config, scale=self.scale)
        metadata = {"format": OURS, "config": self.config, "lora": quote_path(self.source.name)}
        metadata |= metadata_of("dit", configs.get(self.config).chunks)
        with lock_folder(self.out):
            write_file(self.out / file.name, weights, origin=[file, *origin], metadata=metadata)
            link_others(self.out, self.merge)
        return command.ExitCode.DONE

    def _write_checkpoint(
        self,
        changes: Mapping[str, Change],
        config: NetworkConfig,
        origin: Sequence[Path],
        trained_on: Mapping[str, str],
    ) -> int:
        """Write a folder in the layout of DWM's checkpoints."""
        from egosim_jax.convert.lora_export import checkpoint
        from egosim_jax.io.mapped import read_safetensors

        if self.merge is not None:
            raise InputError(
                "--merge and --layout dwm exclude each other: a checkpoint is not merged. Omit one "
                "of them."
            )
        base = None if self.base is None else read_safetensors(self.base / "dit.safetensors")
        with lock_folder(self.out):
            for stem, tensors in checkpoint(changes, config, base).items():
                target = self.out / f"{stem}.safetensors"
                weights = in_memory(tensors)
                metadata = {"format": "pt", **trained_on}
                write_file(target, weights, origin=origin, metadata=metadata)
        return command.ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Compare a weights folder with the checkpoint that it was converted from.

    Every value must equal the source's bit for bit, after the change of layout and dtype, and match
    its checksum. With torch, diffusers and transformers installed, it also compares one forward of
    each network.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """File in .safetensors or .pth format, or folder of them."""
    weights: Annotated[Path, tyro.conf.Positional]
    """Weights folder converted from it."""
    config: str
    """Name of the model."""
    prefix: str | None = None
    """Value of --prefix in the conversion."""
    widen: WidenMode | None = None
    """Value of --widen in the conversion."""

    def run(self) -> int:
        """Compare the weights; return 1 if any differs."""
        from egosim_jax import configs
        from egosim_jax.convert import reference
        from egosim_jax.io.mapped import read_safetensors

        config = configs.get(self.config)
        wrong = []
        folder = detect(self.source, config).only(self.prefix)
        files = {f.network: self.weights / f"{f.network}.safetensors" for f in folder.found}
        if not any(file.exists() for file in files.values()):
            raise InputError(
                f"{quote_path(self.weights)} has none of the networks of "
                f"{quote_path(self.source)}, {', '.join(files) or 'which has none'}."
            )
        for found in map(folder.network, files):
            file = files[found.network]
            if not file.exists():
                print(f"{found.network}: not converted")
                continue
            widening = _widening(found, config, self.widen)
            # `_same` casts each piece to the dtype in the file: any dtype does here.
            weights = to_jax(found, config, dtype="float32", widening=widening)
            tensors = read_safetensors(file)
            if problems := mismatches(tensors, {w.name: w.shape for w in weights}):
                raise WeightsError(problems, source=str(file))
            damaged = [name for name, tensor in tensors.items() if not tensor.intact]
            wrong += [f"{found.network}: {name} does not match its checksum" for name in damaged]
            if not any(tensor.checksums for tensor in tensors.values()):
                print(f"{found.network}: no checksums; converting again adds them")
            differ = [
                weight.name
                for weight in track(weights, f"comparing {found.network}", total=len(weights))
                if weight.name not in damaged and not _same(weight, tensors[weight.name])
            ]
            equal = len(weights) - len(differ) - len(damaged)
            print(f"{found.network}: {equal} of {len(weights)} weights equal")
            wrong += [f"{found.network}: {name} differs" for name in differ]
            if found.table.reference is None:
                print(f"{found.network}: no forward compared: its table has no reference")
            elif reference.possible() and not damaged:
                network = network_config(config, found.network)
                error = reference.relative_error(found, file, network, widening=widening)
                print(f"{found.network}: forward differs from PyTorch's by {error:.1e}")
                if not error <= reference.TOLERANCE:
                    wrong.append(f"{found.network}: forward differs by more than rounding")
        if not reference.possible():
            print(f"no forward compared: that needs {', '.join(reference.MODULES)}")
        print(printable("\n".join(wrong)), end="\n" if wrong else "")
        return command.ExitCode.FAILED if wrong else command.ExitCode.DONE


def _widening(
    found: DetectedNetwork, config: ModelConfig, mode: WidenMode | None
) -> Widening | None:
    """Return the widening of a denoiser, or None for other networks and without a mode."""
    return widening_of(config, mode) if mode and found.network == "dit" else None


def _hash(folder: Path) -> str:
    """Return the hash of the denoiser in a weights folder."""
    found = hashes(folder, only=("dit",))
    if not found:
        raise InputError(f"{quote_path(folder)} has no dit.safetensors. (--merge, --base)")
    return found["dit"]


def _same(weight: Weight, tensor: Tensor) -> bool:
    """Return True if the tensor equals the pieces, cast to its dtype, bit for bit."""
    import numpy as np

    parts = tensor.array().reshape(len(weight.pieces), -1)
    return all(
        np.array_equal(
            in_rows(piece().astype(tensor.dtype, copy=False)).reshape(-1).view(np.uint8),
            part.view(np.uint8),
        )
        for part, piece in zip(parts, weight.pieces, strict=True)
    )
