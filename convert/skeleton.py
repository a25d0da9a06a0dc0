"""Networks without weights, to know what a conversion has to find."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from egosim_jax.io.weights import flat_shapes

if TYPE_CHECKING:
    from flax import nnx

    from egosim_jax.convert.layouts import Network


@cache  # making the modules takes most of a second
def shapes(network: Network, shape: Any) -> dict[str, tuple[int, ...]]:
    """Of every weight of a config's network, by its path."""
    return flat_shapes(skeleton(network, shape))


def skeleton(network: Network, shape: Any) -> nnx.Module:
    """The network of a config, without weights."""
    from egosim_jax.models import abstract

    return abstract(shape)
