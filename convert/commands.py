"""What `egosim-convert` does."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from egosim_jax import command
from egosim_jax.convert.layouts import Naming, Network, naming_in, recognize
from egosim_jax.convert.plan import TABLES, Widening, fits, to_ours, to_theirs
from egosim_jax.convert.source import INDEX
from egosim_jax.convert.stream import Weight, in_rows, write
from egosim_jax.convert.theirs import FOLDERS, pipeline
from egosim_jax.io.atomic import atomic_folder, lock_folder
from egosim_jax.io.mapped import OURS, Tensor
from egosim_jax.io.run import write_json
from egosim_jax.io.untrusted import quote_path, read_bytes
from egosim_jax.io.weights import WeightsError, hashes, link_others, mismatches
from egosim_jax.progress import track, track_bytes
from egosim_jax.types import InputError

Dtype = Literal["float32", "bfloat16", "float16"]


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
        """Recognize, match with the configs, print."""
        from rich.console import Console
        from rich.table import Table

        from egosim_jax import configs

        folder = recognize(self.source)
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
                ", ".join(n for n in configs.names() if fits(found, configs.get(n))) or "none",
            )
        console = Console(width=160, markup=False, emoji=False, highlight=False)
        console.print(table)
        missing = [name for name in TABLES if name not in {f.network for f in folder.found}]
        for source in folder.unknown:
            console.print(f"{source.name}: no network of ours ({len(source.tensors)} tensors)")
        console.print(f"missing networks: {', '.join(missing) or 'none'}")
        console.print(f"tokenizer: {quote_path(folder.tokenizer or 'none')}")
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
    dtype: Dtype | None = None
    """Store floating weights as this; by default each keeps its own."""
    widen: Widening | None = None
    """Make a model of 52 channels from a base model of 36, whose kernel for the hands is 0: `copy`
    keeps the rest as it is, `polarity` also turns the mask, which is 1 for the base where it is 0
    for us."""

    def run(self) -> int:
        """Recognize, check, write."""
        from egosim_jax import configs

        config = configs.get(self.config)
        folder = recognize(self.source)
        names = self.only or tuple(dict.fromkeys(found.network for found in folder.found))
        if not names:
            raise InputError(
                f"{quote_path(self.source)} holds no network of ours. (egosim-convert inspect)"
            )
        apart(self.out, self.source)
        planned = []
        for found in map(folder.network, names):
            widen = self.widen if found.network == "dit" else None
            planned.append((found, to_ours(found, config, dtype=self.dtype, widen=widen)))
            for file in found.source.files:
                apart(self.out / f"{found.network}.safetensors", file)
        kept = {}
        if folder.tokenizer is not None and "text" in names and config.tokenizer.kind != "byt5":
            kept = tokenizer_files(folder.tokenizer, within=self.source)
        with lock_folder(self.out):
            for found, weights in planned:
                target = self.out / f"{found.network}.safetensors"
                about = {"format": OURS, "config": self.config, "source": found.source.name}
                _write(target, weights, origin=found.source.files, metadata=about)
            if kept:
                with atomic_folder(self.out / config.tokenizer.kind) as temporary:
                    for name, data in kept.items():
                        (temporary / name).write_bytes(data)
        return command.DONE


STEMS: dict[tuple[Network, Naming], str] = {
    ("dit", "wan"): "diffusion_pytorch_model",
    ("vae", "wan"): "Wan2.1_VAE",
    ("text", "wan"): "models_t5_umt5-xxl-enc-bf16",
    ("image", "wan"): "models_clip_open-clip-xlm-roberta-large-vit-huge-14",
    ("dit", "diffusers"): "diffusion_pytorch_model",
    ("vae", "diffusers"): "diffusion_pytorch_model",
    ("text", "transformers"): "model",
    ("image", "transformers"): "model",
}
"""What the files of a network in a naming are called."""
LARGEST = 5_000_000_000
"""Bytes of a file of several."""


@dataclass(frozen=True, kw_only=True)
class ToTorch:
    """Write a weights folder as safetensors in PyTorch names, which the other projects load.

    `wan` is the layout of the Wan and EgoSim releases; `diffusers` has a folder for each network,
    with the configs that `from_pretrained` reads, but for the tokenizer, which is passed to it.
    Networks above 5 GB become several files with an index.
    """

    weights: Annotated[Path, tyro.conf.Positional]
    """Weights folder."""
    config: str
    """Name of the model that they are of."""
    out: Path
    """Folder to write to."""
    layout: Literal["wan", "diffusers"] = "wan"
    """Whose names and files."""
    only: tuple[Network, ...] = ()
    """Write these networks alone."""
    dtype: Dtype | None = None
    """Store floating weights as this; by default each keeps its own."""

    def run(self) -> int:
        """Check, translate, write."""
        from egosim_jax import configs
        from egosim_jax.io.mapped import read_safetensors

        config = configs.get(self.config)
        apart(self.out, self.weights)
        planned = []
        here: list[Network] = [name for name in TABLES if getattr(config, name) is not None]
        for network in self.only or here:
            file = self.weights / f"{network}.safetensors"
            naming = naming_in(self.layout, network)
            tensors = read_safetensors(file)
            theirs = to_theirs(tensors, config, network, naming, dtype=self.dtype)
            folder = self.out / FOLDERS[network] if self.layout == "diffusers" else self.out
            planned.append((network, folder / STEMS[network, naming], file, theirs))
        with lock_folder(self.out):
            for _, stem, file, theirs in planned:
                _write_sharded(stem, theirs, origin=[file])
            if self.layout == "diffusers":
                for path, settings in pipeline(
                    config, [network for network, *_ in planned]
                ).items():
                    write_json(self.out / path, settings)
        return command.DONE


@dataclass(frozen=True, kw_only=True)
class Lora:
    """Bring a LoRA into the names that ComfyUI and diffusers both read, or merge it into weights.

    Reads PEFT's, diffusers', kohya's (VideoX-Fun, musubi) and ComfyUI's names, alpha honored.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """The LoRA: a file, or PEFT's folder."""
    config: str
    """Name of the model that it is for."""
    out: Path
    """File to write or, with --merge, weights folder, whose other networks are links."""
    merge: Path | None = None
    """Weights folder that it is added to."""
    scale: float = 1.0
    """How strongly it counts in a merge."""
    base: Path | None = None
    """Weights folder that it was trained on, whose hash goes into the file's header."""

    def run(self) -> int:
        """Read, check, write."""
        from egosim_jax import configs
        from egosim_jax.convert.lora import (
            about_lora,
            check_base,
            exported,
            metadata_of,
            read_lora,
        )
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
        changes = read_lora(self.source, config)
        origin = [self.source]
        if self.source.is_dir():
            origin = sorted(file for file in self.source.iterdir() if file.is_file())
        if self.merge is None:
            said = about_lora(changes)
            for known in (*base, *filter(None, [metadata_of(self.source).get(BASE)])):
                said[BASE] = known
            weights = [
                Weight(
                    name=name, shape=tensor.shape, dtype=tensor.dtype, pieces=(lambda t=tensor: t,)
                )
                for name, tensor in exported(changes, config).items()
            ]
            with lock_folder(self.out.parent):
                _write(self.out, weights, origin=origin, metadata=said)
            return command.DONE
        file = self.merge / "dit.safetensors"
        weights = merged(read_safetensors(file), changes, config, scale=self.scale)
        about = {"format": OURS, "config": self.config, "lora": quote_path(self.source.name)}
        with lock_folder(self.out):
            _write(self.out / file.name, weights, origin=[file, *origin], metadata=about)
            link_others(self.out, self.merge)
        return command.DONE


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Compare a weights folder with the checkpoint that it was made from, tensor by tensor.

    Every value must be the source's, bit for bit, after the change of layout and dtype, and what
    its checksums say. Where torch, diffusers and transformers are installed, one forward of each
    network is compared, too.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """A .safetensors or .pth file, or a folder of them."""
    weights: Annotated[Path, tyro.conf.Positional]
    """Weights folder."""
    config: str
    """Name of the model."""
    widen: Widening | None = None
    """As it was converted."""

    def run(self) -> int:
        """Compare; 1 if anything differs."""
        from egosim_jax import configs
        from egosim_jax.convert import forward
        from egosim_jax.io.mapped import read_safetensors

        config = configs.get(self.config)
        wrong = []
        folder = recognize(self.source)
        files = {f.network: self.weights / f"{f.network}.safetensors" for f in folder.found}
        if not any(file.exists() for file in files.values()):
            raise InputError(
                f"{quote_path(self.weights)} has none of the networks of "
                f"{quote_path(self.source)}, {', '.join(files) or 'which holds none'}."
            )
        for found in folder.found:
            file = files[found.network]
            if not file.exists():
                print(f"{found.network}: not converted")
                continue
            widen = self.widen if found.network == "dit" else None
            weights = to_ours(found, config, widen=widen)
            tensors = read_safetensors(file)
            if problems := mismatches(tensors, {w.name: w.shape for w in weights}):
                raise WeightsError(problems, source=str(file))
            damaged = [name for name, tensor in tensors.items() if not tensor.intact]
            wrong += [f"{found.network}: {name} is not what was written" for name in damaged]
            if not any(tensor.checksums for tensor in tensors.values()):
                print(f"{found.network}: carries no checksums; converting again adds them")
            differ = [
                weight.name
                for weight in track(weights, f"comparing {found.network}", total=len(weights))
                if weight.name not in damaged and not _same(weight, tensors[weight.name])
            ]
            equal = len(weights) - len(differ) - len(damaged)
            print(f"{found.network}: {equal} of {len(weights)} weights equal")
            wrong += [f"{found.network}: {name} differs" for name in differ]
            if forward.possible() and not damaged:
                error = forward.difference(found, file, config, widen=widen)
                print(f"{found.network}: forward differs from PyTorch's by {error:.1e}")
                if not error <= forward.TOLERANCE:
                    wrong.append(f"{found.network}: forward differs by more than rounding")
        if not forward.possible():
            print(f"no forward compared: that takes {', '.join(forward.MODULES)}")
        print("\n".join(wrong), end="\n" if wrong else "")
        return command.FAILED if wrong else command.DONE


def apart(out: Path, source: Path) -> None:
    """Raise `InputError` if what is written is, or lies in, what it is made from."""
    here, there = (Path(os.path.realpath(path)) for path in (out, source))
    if there in (here, *here.parents):
        raise InputError(
            f"{quote_path(out)} is, or lies in, {quote_path(source)}, which is read: choose a "
            "place apart. (--out)"
        )


TOKENIZER_FILES = (
    "tokenizer.json", "spiece.model", "tokenizer_config.json", "special_tokens_map.json",
)  # fmt: skip
MOST_TOKENIZER = 64 << 20
"""Bytes of each."""


def tokenizer_files(folder: Path, *, within: Path) -> dict[str, bytes]:
    """The files of a tokenizer. Raises `InputError` for links, which may lead anywhere."""
    files = [folder / name for name in TOKENIZER_FILES if os.path.lexists(folder / name)]
    inner = [path for path in (folder, *folder.parents) if within in path.parents]
    for path in (*inner, *files):
        if path.is_symlink():
            raise InputError(
                f"{quote_path(path)} is a link: those of a tokenizer are not followed. Copy the "
                "checkpoint's folder with `cp -rL`, if you trust where its links lead."
            )
    return {file.name: read_bytes(file, limit=MOST_TOKENIZER) for file in files}


def _hash(folder: Path) -> str:
    """Of the video transformer of a weights folder."""
    found = hashes(folder, only=("dit",))
    if not found:
        raise InputError(f"{quote_path(folder)} has no dit.safetensors. (--merge, --base)")
    return found["dit"]


def _same(weight: Weight, tensor: Tensor) -> bool:
    """Whether all pieces are in the tensor, as its dtype."""
    import numpy as np

    places = tensor.array().reshape(len(weight.pieces), -1)
    return all(
        np.array_equal(
            in_rows(piece().astype(tensor.dtype, copy=False)).reshape(-1).view(np.uint8),
            place.view(np.uint8),
        )
        for place, piece in zip(places, weight.pieces, strict=True)
    )


def _write(
    target: Path, weights: Sequence[Weight], *, origin: Sequence[Path], metadata: Mapping[str, str]
) -> None:
    total = sum(weight.bytes for weight in weights)
    pieces = write(target, weights, origin=origin, metadata=metadata)
    for _ in track_bytes(pieces, f"writing {target.name}", total=total):
        pass
    print(quote_path(target))


def _write_sharded(stem: Path, weights: Sequence[Weight], *, origin: Sequence[Path]) -> None:
    """One file or, above 5 GB, several and an index."""
    shards: list[list[Weight]] = [[]]
    for weight in weights:
        if shards[-1] and sum(w.bytes for w in shards[-1]) + weight.bytes > LARGEST:
            shards.append([])
        shards[-1].append(weight)
    places = {}
    for number, shard in enumerate(shards, start=1):
        end = f"-{number:05d}-of-{len(shards):05d}" if len(shards) > 1 else ""
        target = stem.with_name(f"{stem.name}{end}.safetensors")
        _write(target, shard, origin=origin, metadata={"format": "pt"})
        places |= {weight.name: target.name for weight in shard}
    if len(shards) > 1:
        total = sum(weight.bytes for weight in weights)
        index = {"metadata": {"total_size": total}, "weight_map": places}
        write_json(stem.with_name(f"{stem.name}{INDEX}"), index)
