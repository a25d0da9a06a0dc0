"""Where arrays live: the device mesh, the logical axes of weights, and the rules between them.

Networks know no mesh. Each weight names its logical axes (`models/layers.py`); the one table here
maps them to mesh axes. A batch is split over `data` and `fsdp` together; weights, gradients and
optimiser state are split over `fsdp` along their model width and repeated over `data`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
from flax import nnx
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from egosim_jax.types import InputError

RULES: Mapping[str, str] = {"embed": "fsdp"}
"""Logical axis to mesh axis; an axis that is not listed is never split."""

BATCH = PartitionSpec(("data", "fsdp"))
"""How every array with a leading batch axis is split."""


@dataclass(frozen=True, kw_only=True)
class MeshConfig:
    """Sizes of the mesh axes; their product is the number of devices."""

    data: int = 1
    """Copies of the weights, each with its own part of the batch."""
    fsdp: int = -1
    """Devices that share one copy of the weights; -1 takes all that are left."""


def make_mesh(config: MeshConfig) -> Mesh:
    """Lay the devices out as data x fsdp, or say how many there are."""
    devices = jax.device_count()
    fsdp = devices // config.data if config.fsdp == -1 else config.fsdp
    if config.data < 1 or fsdp < 1 or config.data * fsdp != devices:
        raise InputError(
            f"A mesh of data {config.data} x fsdp {config.fsdp} does not fit {devices} devices: "
            "the product of the axes must be the number of devices. (--training.mesh.data, "
            "--training.mesh.fsdp)"
        )
    return jax.make_mesh((config.data, fsdp), ("data", "fsdp"), axis_types=(AxisType.Auto,) * 2)


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """The sharding of arrays with a leading batch axis."""
    return NamedSharding(mesh, BATCH)


def state_sharding(mesh: Mesh, tree: Any) -> Any:
    """The sharding of every leaf of a pytree that may hold nnx variables (params, moments).

    A variable is split by the logical axes that it names; other leaves are repeated. An axis
    whose size the mesh axis does not divide is repeated too, so that tiny models run anywhere.
    """

    def place(leaf: Any) -> Any:
        if not isinstance(leaf, nnx.Variable):
            return NamedSharding(mesh, PartitionSpec())
        if not jax.tree.leaves(leaf):  # where optax masks a variable out of its moments
            return leaf
        spec = _spec(mesh, tuple(leaf.shape), leaf.get_metadata().get("axes"))
        return leaf.replace(NamedSharding(mesh, spec))

    return jax.tree.map(place, tree, is_leaf=lambda leaf: isinstance(leaf, nnx.Variable))


def _spec(mesh: Mesh, shape: tuple[int, ...], axes: tuple[str | None, ...] | None) -> PartitionSpec:
    used: set[str] = set()
    spec: list[str | None] = []
    for size, axis in zip(shape, axes or (None,) * len(shape), strict=True):
        target = RULES.get(axis) if axis else None
        if target is None or target in used or size % mesh.shape[target]:
            spec.append(None)
        else:
            used.add(target)
            spec.append(target)
    return PartitionSpec(*spec)
