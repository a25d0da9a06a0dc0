"""Linear layers with weights in 8 bits, for inference.

A kernel W `[in, out]` becomes Q of int8 or float8 (e4m3) and a float32 scale s of each output
channel, so that W is about Q s. With m = 127 or 448, the maximum of the dtype,

    s = max |W| / m over the channel, 1 for a channel of zeros,    Q = round(W / s)

The layer computes (x Q) s + b: the factors are in the compute dtype, which holds every value of Q,
and sums and scale are float32. With 8-bit activations, x becomes 8 bits too, with a scale of each
token, and the product is of two 8-bit arrays: int8 sums in int32. NVIDIA GPUs since Hopper multiply
float8, TPUs int8; XLA's CPU compiler converts both to a wider dtype.

Linear layers of the blocks are in 8 bits: attention and MLP. Embeddings, norms, modulation and
heads stay as they are.

This does not use qwix, which fits our versions of jax and flax. qwix replaces weights when it
intercepts the operation that uses them; here that is inside `lax.scan` over stacked blocks, where
nnx refuses it ("Cannot mutate 'Linear' from different trace level"). Its arrays would also need
their own names in files, and their own shardings.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import reduce
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.io.weights import check_not_in_8_bits
from egosim_jax.models.layers import Linear

Kind = Literal["int8", "float8"]
"""Kind of weights in 8 bits."""
DTYPES: Mapping[Kind, np.dtype] = {
    "int8": np.dtype(np.int8),
    "float8": np.dtype(ml_dtypes.float8_e4m3fn),
}
"""Dtype of each kind."""
NETWORKS = ("dit", "text")
"""Networks of a model that are in 8 bits; activations in 8 bits are the denoiser's only."""
LAYERS = ("q", "k", "v", "o", "gate", "up", "down")
"""Names of the linear layers of blocks that are in 8 bits."""


def layers_of(paths: Iterable[str]) -> list[str]:
    """Return the paths of the linear layers to store in 8 bits, out of the paths of weights."""
    layers = (path.removesuffix(".kernel") for path in paths if path.endswith(".kernel"))
    return [layer for layer in layers if _is_in_block(layer.split("."))]


def _is_in_block(names: list[str]) -> bool:
    return names[0] == "blocks" and names[-1] in LAYERS


def maximum(dtype: np.dtype) -> float:
    """Return the maximum value of an 8-bit dtype."""
    return 127.0 if dtype == np.int8 else float(ml_dtypes.finfo(dtype).max)


def channel_scales(kernel: Float[np.ndarray, "i o"], dtype: np.dtype) -> Float[np.ndarray, " o"]:
    """Return the scale of each output channel, in float32; 1 for a channel of zeros.

    Scales of values that are not finite, or too small for float32, are not normal numbers.
    """
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        largest = np.abs(kernel).max(axis=0, initial=0).astype(np.float32)
        return np.where(largest == 0, np.float32(1), largest / np.float32(maximum(dtype)))


def quantized(
    kernel: Float[np.ndarray, "i o"], scales: Float[np.ndarray, " o"], dtype: np.dtype
) -> np.ndarray:
    """Return a kernel divided by its scales and rounded to an 8-bit dtype."""
    limit = maximum(dtype)
    values = np.clip(kernel.astype(np.float32) / scales, -limit, limit)
    return (np.rint(values) if dtype == np.int8 else values).astype(dtype)


class EightBitLinear(nnx.Module):
    """Linear layer with an 8-bit kernel, in place of a `Linear`, and with shapes for weights."""

    def __init__(self, linear: Linear, dtype: np.dtype, *, activations: bool):
        shape, axes = linear.kernel.shape, linear.kernel.get_metadata()["axes"]
        self.dtype, self.products, self.activations = linear.dtype, linear.products, activations
        self.kernel = nnx.Param(jax.ShapeDtypeStruct(shape, dtype), axes=axes)
        # Sharded like the output axis of the kernel.
        scale = jax.ShapeDtypeStruct((*shape[:-2], shape[-1]), np.float32)
        self.scale = nnx.Param(scale, axes=(*axes[:-2], axes[-1]))
        self.bias = linear.bias

    def __call__(self, x: Float[Array, "*b i"]) -> Float[Array, "*b o"]:
        """Project the last axis."""
        kernel = self.kernel[...]
        if self.activations:
            rows, row_scales = quantized_rows(x, kernel.dtype)
            y = _dot(rows, kernel) * row_scales
        else:
            factors = self.products or self.dtype
            y = _dot(x.astype(factors), kernel.astype(factors))
        y = (y * self.scale[...]).astype(self.dtype)
        return y if self.bias is None else y + self.bias[...].astype(self.dtype)


def quantized_rows(x: Float[Array, "*b i"], dtype: Any) -> tuple[Array, Float[Array, "*b 1"]]:
    """Return activations in 8 bits, and the scale of each row, in float32."""
    x, limit = x.astype(jnp.float32), maximum(np.dtype(dtype))
    largest = jnp.abs(x).max(-1, keepdims=True)
    # A row of zeros has a scale, too. The scale of a row with NaN is NaN, and so is the product.
    scales = jnp.maximum(largest / limit, jnp.finfo(jnp.float32).tiny)
    values = jnp.clip(x / scales, -limit, limit)
    return (jnp.rint(values) if dtype == jnp.int8 else values).astype(dtype), scales


def _dot(x: Array, kernel: Array) -> Float[Array, "*b o"]:
    """Return the product over x's last axis in float32; sums of int8 are exact."""
    sums = jnp.int32 if x.dtype == jnp.int8 else jnp.float32
    axes = (((x.ndim - 1,), (0,)), ((), ()))
    y = jax.lax.dot_general(x, kernel, axes, preferred_element_type=sums)
    return y.astype(jnp.float32)


def check_lora(folder: Path) -> None:
    """Raise `InputError` if the denoiser of a weights folder is in 8 bits: it takes no LoRA."""
    fix = (
        "Merge the LoRA into the weights that they were made of (egosim convert lora --merge), and "
        "quantize the merged ones (egosim convert quantize). (--lora, --weights)"
    )
    check_not_in_8_bits(folder, ["dit"], use="take no LoRA", fix=fix)


def adapt(network: Any, layers: Mapping[str, np.dtype], *, activations: bool = False) -> None:
    """Replace linear layers of an abstract network by 8-bit ones, in place, by dotted path.

    Other paths are ignored.
    """
    modules = {".".join(map(str, path)): module for path, module in nnx.iter_modules(network)}
    for path, dtype in layers.items():
        if isinstance(linear := modules.get(path), Linear):
            *above, name = path.split(".")
            layer = EightBitLinear(linear, dtype, activations=activations)
            setattr(reduce(getattr, above, network), name, layer)
