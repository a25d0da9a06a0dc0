"""`egosim convert quantize`: weights in 8 bits, from a weights folder of ours.

`models/eight_bit.py` has the formulas. A scale is computed once to be written and once more for
the layer's kernel: so each piece depends on the source alone, and an interrupted file is continued.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from egosim_jax.convert.finite import all_finite, out_of_range
from egosim_jax.convert.writer import PLAN, Weight, apart, write_file
from egosim_jax.io.atomic import lock_folder
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.mapped import (
    CHECKSUMS,
    HASH,
    Tensor,
    read_metadata,
    read_safetensors,
    read_weights_hash,
)
from egosim_jax.io.weights import STUDENT, add_others, check_folder, layers_in_8_bits
from egosim_jax.models.eight_bit import (
    DTYPES,
    NETWORKS,
    Kind,
    channel_scales,
    layers_of,
    quantized,
)
from egosim_jax.runtime import command
from egosim_jax.types import InputError

QUANTIZED, SOURCE = "quantized", "source_sha256"
"""Metadata of a file in 8 bits: the kind, and the hash of the weights that it was made of."""
TINY = np.finfo(np.float32).tiny
"""Minimum scale: devices read smaller numbers as 0."""


@dataclass(frozen=True, kw_only=True)
class Quantize:
    """Convert a weights folder to 8 bits: the linear layers in the blocks of denoiser and text.

    A kernel gets a scale of each output channel; other weights stay as they are, and the other
    networks are linked. Commands that generate recognize the new folder. Weights that are not
    finite, whose scales float32 cannot hold, or that are in 8 bits already, are refused. Running
    the same command again resumes an interrupted conversion.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """Weights folder to convert."""
    out: Path
    """Weights folder to write."""
    kind: Kind
    """Dtype of the kernels: float8 (e4m3) for NVIDIA GPUs since Hopper, int8 for TPUs."""
    only: tuple[str, ...] = NETWORKS
    """Convert only these networks: dit, text."""

    def run(self) -> int:
        """Check, convert and link the networks."""
        apart(self.out, self.source)
        check_folder(self.source, "CONFIG")
        if bad := sorted(set(self.only) - set(NETWORKS)) or not self.only:
            raise InputError(
                f"Only {' and '.join(NETWORKS)} can be in 8 bits, not {bad or 'nothing'}. (--only)"
            )
        files = {name: self.source / f"{name}.safetensors" for name in self.only}
        planned = {file: quantized_weights(file, self.kind) for file in files.values()}
        with lock_folder(self.out):
            for file, weights in planned.items():
                metadata = quantized_metadata(file, self.kind)
                target = self.out / file.name
                write_file(target, weights, origin=[file], metadata=metadata, settings=self.kind)
            add_others(self.out, self.source, student=False)
        if (self.source / STUDENT).exists():
            print(
                f"{STUDENT} was omitted: it is a LoRA of {quote_path(self.source)}. Merge it "
                "first (egosim convert lora --merge), and quantize the merged weights.",
                file=sys.stderr,
            )
        return command.ExitCode.DONE


def quantized_metadata(file: Path, kind: Kind) -> dict[str, str]:
    """Return the metadata of a file in 8 bits, with the metadata of its source."""
    kept = read_metadata(file)
    of_values = {HASH, CHECKSUMS, PLAN}
    kept = {name: text for name, text in kept.items() if name not in of_values}
    return kept | {QUANTIZED: kind, SOURCE: read_weights_hash(file)}


def quantized_weights(file: Path, kind: Kind) -> list[Weight]:
    """Return the weights of a file in 8 bits. Raises `InputError` if it cannot be converted."""
    tensors = read_safetensors(file)
    if layers_in_8_bits(tensors):
        raise InputError(
            f"{quote_path(file)} has weights in 8 bits already. Give the weights that it was made "
            "of."
        )
    layers = layers_of(tensors)
    if not layers or any(len(tensors[f"{layer}.kernel"].shape) != 3 for layer in layers):
        raise InputError(
            f"{quote_path(file)} has no stack of blocks with linear layers, so nothing can be in 8 "
            "bits. (--only)"
        )
    planned = []
    for name, tensor in tensors.items():
        layer = name.removesuffix(".kernel")
        if layer != name and layer in layers:
            planned += _layer(layer, tensor, DTYPES[kind])
        else:
            planned.append(
                Weight(name=name, shape=tensor.shape, dtype=tensor.dtype, pieces=(tensor.array,))
            )
    return planned


def _layer(layer: str, kernel: Tensor, dtype: np.dtype) -> Sequence[Weight]:
    """Return kernel and scale of a linear layer of all blocks, block by block."""
    blocks, _, out = kernel.shape
    names = [f"{layer} of block {number}" for number in range(blocks)]

    def scale(number: int) -> np.ndarray:
        return _scales(kernel.array()[number], dtype, name=names[number])

    def piece(number: int) -> np.ndarray:
        return quantized(kernel.array()[number], scale(number), dtype)[None]

    return [
        Weight(
            name=f"{layer}.kernel",
            shape=kernel.shape,
            dtype=dtype,
            pieces=tuple(partial(piece, number) for number in range(blocks)),
        ),
        Weight(
            name=f"{layer}.scale",
            shape=(blocks, out),
            dtype=np.dtype(np.float32),
            pieces=tuple(partial(scale, number) for number in range(blocks)),
        ),
    ]


def _scales(kernel: np.ndarray, dtype: np.dtype, *, name: str) -> np.ndarray:
    """Return the scales of a kernel. Raises `InputError` naming one that cannot be stored."""
    if not all_finite(kernel):
        raise out_of_range(kernel, kernel.dtype, name=name, fix="")
    scales = channel_scales(kernel, dtype)
    bad = np.flatnonzero(~np.isfinite(scales) | (scales < TINY))
    if bad.size:
        largest = float(np.abs(kernel[:, bad[0]].astype(np.float64)).max())
        raise InputError(
            f"{name}: output channel {bad[0]} has values up to {largest:.4g}, whose scale float32 "
            f"cannot hold; {bad.size} channels are so. Such weights are wrong: train or download "
            "them again, or leave the network out. (--only)"
        )
    return scales


def sources_of(source: Path, folder: Path) -> Mapping[str, tuple[Path, Kind]]:
    """Return the source file and the kind of each network of a folder in 8 bits, by name.

    Raises `InputError` if the source is not a weights folder of ours.
    """
    sources: dict[str, tuple[Path, Kind]] = {}
    for name in NETWORKS:
        file = folder / f"{name}.safetensors"
        layers = layers_in_8_bits(read_safetensors(file)) if file.is_file() else {}
        for kind, dtype in DTYPES.items():
            if dtype in layers.values():
                sources[name] = source / file.name, kind
    if sources:
        check_folder(source, "CONFIG")
    return sources
