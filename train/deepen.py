"""Deeper Wan transformers that compute what a shallower one does.

A new block copies the block before it, but its three output projections are 0: it adds nothing to
the residual stream. From the first update on, gradients reach these projections.
"""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from egosim_jax.io import weights
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.types import InputError

STACKED = "blocks."
"""Prefix of the tensors with a leading layers axis."""
OUTPUTS = ("blocks.*_attn.o.*", "blocks.mlp.down.*")
"""Tensors of a block's output projections."""


def deepen(tensors: Mapping[str, np.ndarray], layers: int) -> dict[str, np.ndarray]:
    """Return the tensors of a denoiser with new blocks, evenly between the others.

    Raises `InputError` if it has more blocks than `layers`, or less than half of them.
    """
    depth = next(len(tensor) for name, tensor in tensors.items() if name.startswith(STACKED))
    if not depth <= layers <= 2 * depth:
        raise InputError(
            f"A denoiser of {depth} blocks can be deepened to {depth} to {2 * depth} blocks, not "
            f"to {layers}."
        )
    # Block i of the result copies block origin[i]; it is new if the block before it is that block.
    origin = np.floor(np.arange(layers) * depth / layers).astype(int)
    new = np.concatenate([[False], np.diff(origin) == 0])
    found = {}
    for name, tensor in tensors.items():
        if name.startswith(STACKED):
            tensor = tensor[origin]
            if any(fnmatch(name, pattern) for pattern in OUTPUTS):
                tensor = np.where(new.reshape(-1, *[1] * (tensor.ndim - 1)), 0, tensor)
        found[name] = np.asarray(tensor)
    return found


def deepen_weights(source: Path, layers: int, out: Path) -> Path:
    """Write the weights folder of a denoiser with `layers` blocks; other networks are links.

    Returns `source` itself if it has this many blocks.
    """
    file = source / "dit.safetensors"
    tensors = {name: np.array(tensor.array()) for name, tensor in read_safetensors(file).items()}
    deeper = deepen(tensors, layers)
    if all(deeper[name].shape == tensor.shape for name, tensor in tensors.items()):
        return source
    out.mkdir(parents=True, exist_ok=True)
    weights.write(out / file.name, deeper)
    weights.link_others(out, source)
    return out
