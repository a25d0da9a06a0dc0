"""A VAE with a wider decoder that computes at first what a narrower one does.

New channels are 0 everywhere: no layer writes to them. Layers read them with random weights, so
that from the first update on gradients reach what writes to them. Of n channels instead of m, two
operations depend on their number, which the weights absorb:

    RMS norm      x / sqrt(sum x^2 / n) grows by sqrt(n / m)   scale  * sqrt(m / n)
    attention     q k / sqrt(n) shrinks by sqrt(m / n)         q      * sqrt(n / m)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egosim_jax.io import weights
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.models import VideoCodecConfig, abstract

PARTS = {"qkv": 3, "time": 2}
"""Equal parts of a layer's output channels, each of which grows, by the layer's name; else one."""


def with_decoder_of(config: VideoCodecConfig, folder: Path, out: Path) -> Path:
    """Return a weights folder whose VAE has the config's decoder: `folder`, or OUT, made of it.

    Raises `WeightsError` if more differs than the decoder's width.
    """
    file, vae = folder / "vae.safetensors", abstract(config)
    narrow = {name: tensor.array() for name, tensor in read_safetensors(file).items()}
    shapes = weights.flat_shapes(vae)
    if not weights.mismatches(narrow, shapes):
        return folder
    draw = np.random.default_rng(0)
    wider = {
        name: _widen(name, value, shapes[name], draw)
        for name, value in narrow.items()
        if name.startswith("decoder.") and value.ndim == len(shapes.get(name, ()))
    }
    weights.fill(vae, {**narrow, **wider}, dtype="float32", source=str(file))
    weights.save(out / file.name, vae)
    weights.link_others(out, folder)
    return out


def _widen(
    name: str,
    narrow: np.ndarray,
    shape: tuple[int, ...],
    draw: np.random.Generator,
) -> np.ndarray:
    """Return a parameter of the wider decoder, in float32."""
    *_, layer, kind = name.split(".")
    few, many = narrow.shape[-1], shape[-1]
    if kind == "scale":
        scale = np.ones(many, np.float32)
        scale[:few] = narrow * np.sqrt(few / many)
        return scale
    wide = np.zeros(shape, np.float32)
    parts = PARTS.get(layer, 1)
    outputs = np.arange(many).reshape(parts, -1)[:, : few // parts].ravel()
    if kind == "bias":
        wide[outputs] = narrow
    else:
        read = (*shape[:-1], few)
        wide[..., outputs] = draw.normal(size=read) / np.sqrt(np.prod(shape[:-1]))
        wide[..., : narrow.shape[-2], outputs] = narrow
    if layer == "qkv":
        wide[..., : many // parts] *= np.sqrt(many / few)
    return wide
