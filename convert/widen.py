"""Widening of a base model's input layer to the channels of another model.

Kernel rows of new input parts are 0: these inputs have no effect until they are trained. If the two
models encode the mask differently, the base's mask is an affine function of the model's,
m_base = shift + scale m. The kernel and bias of the layer absorb it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from egosim_jax.convert.writer import Weight

if TYPE_CHECKING:
    from egosim_jax.conditioning.layout import ChannelLayout

WidenMode = Literal["copy", "polarity"]
"""Encoding of the base model's mask: `copy`, the model's; `polarity`, the base layout's."""


@dataclass(frozen=True, kw_only=True)
class Widening:
    """Change of a denoiser's input from a base model's channel layout to its own."""

    base: ChannelLayout
    layout: ChannelLayout
    input_layer: str
    """Path of the layer that reads the channels, along the first axis of its kernel."""

    @property
    def rows(self) -> np.ndarray:
        """Index, in the model's input, of each of the base's channels."""
        every = np.arange(self.layout.channels)
        return np.concatenate([every[self.layout.slice(name)] for name, _ in self.base.parts])

    @property
    def mask(self) -> tuple[float, float]:
        """Shift and scale that map the model's mask to the base's."""
        ratio = self.base.mask_scale / self.layout.mask_scale
        if self.base.mask_one == self.layout.mask_one:
            return 0.0, ratio
        return self.base.mask_scale, -ratio

    def narrow(self, latents: np.ndarray) -> np.ndarray:
        """Return the base's input for an input of the model, channels last."""
        shift, scale = self.mask
        found = latents[..., self.rows]
        at = self.base.slice("mask")
        found[..., at] = shift + scale * found[..., at]
        return found

    def apply(self, weights: dict[str, Weight]) -> None:
        """Widen the input layer among the weights of a base model, in place."""
        kernel, bias = (weights[f"{self.input_layer}.{name}"] for name in ("kernel", "bias"))
        (read_kernel,), (read_bias,) = kernel.pieces, bias.pieces
        shape = (self.layout.channels, *kernel.shape[1:])
        weights[kernel.name] = replace(
            kernel, shape=shape, pieces=(partial(self._kernel, read_kernel),)
        )
        if self.mask[0]:
            pieces = (partial(self._bias, read_kernel, read_bias),)
            weights[bias.name] = replace(bias, pieces=pieces)

    def _kernel(self, read: Callable[[], np.ndarray]) -> np.ndarray:
        base = read().copy()
        base[self.base.slice("mask")] *= self.mask[1]
        wide = np.zeros((self.layout.channels, *base.shape[1:]), base.dtype)
        wide[self.rows] = base
        return wide

    def _bias(
        self, read_kernel: Callable[[], np.ndarray], read: Callable[[], np.ndarray]
    ) -> np.ndarray:
        mask = read_kernel()[self.base.slice("mask")].astype(np.float64)
        return read().astype(np.float64) + self.mask[0] * mask.sum(axis=tuple(range(mask.ndim - 1)))
