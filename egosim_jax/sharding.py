"""Sharding of arrays: the device mesh, logical axes, and the rules that map them.

The mesh is data x fsdp x context. Networks are independent of it: each weight names its logical
axes (`models/layers.py`), activations are constrained at named cut points (`constrain`), and the
two tables here map logical axes to mesh axes.

    data      replicas of the weights with separate samples; set to the number of hosts for HSDP
    fsdp      devices that shard one replica of the weights, with separate samples
    context   devices that also share samples, each with a part of the tokens; in self-attention
              each has all tokens of a part of the heads (Ulysses: Jacobs et al. 2023, section 3)

Weights, gradients and optimizer state are split over fsdp and context together, along the model
width.

The devices of a process may have any places in the mesh, so its rows of a batch may be any rows
(`process_rows`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from math import prod
from typing import Any, TypeVar

import jax
import numpy as np
from flax import nnx
from jax.experimental import mesh_utils, multihost_utils
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding, PartitionSpec

from egosim_jax.types import InputError, MeshConfig

Module = TypeVar("Module")

WEIGHTS: Mapping[str, tuple[str, ...]] = {"embed": ("fsdp", "context")}
"""Mesh axes of a weight's logical axes; an axis that is not listed is never split."""
ACTIVATIONS: Mapping[str, tuple[str, ...]] = {
    "batch": ("data", "fsdp"),
    "tokens": ("context",),
    "heads": ("context",),
}
"""Mesh axes of an activation's logical axes."""


def make_mesh(config: MeshConfig, devices: Sequence[Any] | None = None) -> Mesh:
    """Return a data x fsdp x context mesh of devices, by default all devices.

    Raises `InputError` if the sizes do not fit the number of devices.
    """
    devices = jax.devices() if devices is None else devices
    wanted = (config.data, config.fsdp, config.context)
    left = len(devices) // max(1, prod(size for size in wanted if size != -1))
    shape = tuple(left if size == -1 else size for size in wanted)
    if wanted.count(-1) > 1 or min(shape) < 1 or prod(shape) != len(devices):
        raise InputError(
            f"A mesh of data {config.data} x fsdp {config.fsdp} x context {config.context} does "
            f"not fit {len(devices)} devices: the product of the axes must be the number of "
            "devices, and only one of them may be -1, which takes the remaining devices. "
            "(--mesh.data, --mesh.fsdp, --mesh.context; in training, after the stage's name)"
        )
    axes = ("data", "fsdp", "context")
    # `jax.make_mesh` refuses mesh axes that split a physical axis of a TPU's torus.
    arranged = mesh_utils.create_device_mesh(shape, devices, allow_split_physical_axes=True)
    return Mesh(arranged, axes, axis_types=(AxisType.Auto,) * 3)


def check_batch(
    size: int, mesh: Mesh | AbstractMesh, grad_accum_steps: int = 1, *, stage: str | None = None
) -> None:
    """Raise `InputError` unless data x fsdp x `grad_accum_steps` divides a batch.

    The message names the options of a training's `stage`.
    """
    groups = parts("batch", mesh)
    unit = groups * grad_accum_steps
    if size % unit:
        in_turn = f", each in {grad_accum_steps} micro-batches" if grad_accum_steps > 1 else ""
        fix = f"Nearest: {-(-size // unit) * unit}."
        if size % groups == 0:
            fix = f"{fix} Or a number of micro-batches that divides {size // groups}."
        raise InputError(
            f"A batch of {size} cannot be shared by a mesh of data {mesh.shape['data']} x fsdp "
            f"{mesh.shape['fsdp']}{in_turn}: it must be a multiple of their product, {unit}. "
            f"{fix} {_batch_options(stage)}"
        )


def _batch_options(stage: str | None) -> str:
    if stage is None:
        return "(--batch-size, or another mesh: devices along context share one sample)"
    return (
        f"(--{stage}.batch-size or --{stage}.grad-accum-steps, or another --{stage}.mesh: devices "
        "along context share one sample)"
    )


def several_devices() -> bool:
    """Return whether the mesh of the current trace has more than one device."""
    return jax.sharding.get_abstract_mesh().size > 1


def platform() -> str:
    """Return the platform of the current trace: `cpu`, `gpu` or `tpu`."""
    return _device().platform


def device_kind() -> str:
    """Return jax's `device_kind` of the current trace."""
    return _device().device_kind


def _device() -> Any:
    device = jax.sharding.get_abstract_mesh().abstract_device
    return jax.devices()[0] if device is None else device


def constrain(x: jax.Array, axes: tuple[str | None, ...]) -> jax.Array:
    """Constrain the sharding of an activation by its logical axes; a no-op on one device."""
    return jax.lax.with_sharding_constraint(x, spec(*axes)) if several_devices() else x


def spec(*axes: str | None) -> PartitionSpec:
    """Return the partition spec of an activation's logical axes."""
    return PartitionSpec(*(ACTIVATIONS[axis] if axis else None for axis in axes))


def parts(axis: str, mesh: Mesh | AbstractMesh | None = None) -> int:
    """Return the number of shards of an activation axis, by default on the current mesh."""
    mesh = jax.sharding.get_abstract_mesh() if mesh is None else mesh
    return prod(mesh.shape[name] for name in ACTIVATIONS[axis])


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Return the sharding of arrays with a leading batch axis."""
    return NamedSharding(mesh, spec("batch"))


def process_rows(sharding: NamedSharding, size: int) -> dict[int, tuple[int, ...]]:
    """Return the rows of a batch that each process holds, ascending, by index of the process.

    These are the rows of its devices, wherever the mesh has them: on TPU slices they are often not
    consecutive. Processes whose devices share samples hold the same rows.
    """
    held: dict[int, list[Any]] = {}
    for device, index in sharding.devices_indices_map((size,)).items():
        held.setdefault(device.process_index, []).append(index)
    return {process: _rows(held[process], size) for process in sorted(held)}


def row_groups(rows: Mapping[int, tuple[int, ...]]) -> dict[tuple[int, ...], list[int]]:
    """Return the processes that hold the same rows, by these rows."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for process, own in rows.items():
        groups.setdefault(own, []).append(process)
    return groups


def assemble(
    rows: Mapping[str, np.ndarray], sharding: NamedSharding, size: int
) -> dict[str, jax.Array]:
    """Return a global batch of `size` rows from this process's rows of it (`process_rows`).

    All processes call it. Row r of the batch is row r, whatever process and device hold it.
    """
    own = _rows(sharding.addressable_devices_indices_map((size,)).values(), size)

    def place(name: str, value: np.ndarray) -> jax.Array:
        if len(value) != len(own):
            raise ValueError(
                f"{name} has {len(value)} rows; this process holds the {len(own)} rows {own} of a "
                f"batch of {size}."
            )

        def part(index: Any) -> np.ndarray:
            # A device holds consecutive rows, so they are consecutive among the process's rows.
            wanted = range(size)[index[0]]
            first = bisect_left(own, wanted[0])
            return value[first : first + len(wanted)]

        return jax.make_array_from_callback((size, *value.shape[1:]), sharding, part)

    return {name: place(name, value) for name, value in rows.items()}


def fetch(array: jax.Array) -> np.ndarray:
    """Return a whole array, on every process.

    All processes that hold a part of it call this.
    """
    if array.is_fully_addressable:
        return np.asarray(array)
    return multihost_utils.process_allgather(array, tiled=True)


def _rows(indices: Iterable[Any], size: int) -> tuple[int, ...]:
    """Return the rows of the indices of a sharding's devices, ascending."""
    return tuple(sorted({row for index in indices for row in range(size)[index[0]]}))


def state_sharding(mesh: Mesh | AbstractMesh, tree: Any) -> Any:
    """Return the sharding of every leaf of a pytree of nnx variables (params, moments).

    A variable is split by its logical axes; other leaves are replicated. An axis whose size the
    mesh axes do not divide is replicated too, so that tiny models run anywhere.
    """

    def place(leaf: Any) -> Any:
        if not isinstance(leaf, nnx.Variable):
            return NamedSharding(mesh, PartitionSpec())
        if not jax.tree.leaves(leaf):  # where optax masks a variable out of its moments
            return leaf
        axes = leaf.get_metadata().get("axes") or (None,) * len(leaf.shape)
        return leaf.replace(NamedSharding(mesh, _fitting(mesh, tuple(leaf.shape), axes)))

    return jax.tree.map(place, tree, is_leaf=lambda leaf: isinstance(leaf, nnx.Variable))


def _fitting(
    mesh: Mesh | AbstractMesh, shape: tuple[int, ...], axes: tuple[str | None, ...]
) -> PartitionSpec:
    """Return the mesh axes of the rules; each is used once, and only where it divides the array."""
    used: set[str] = set()
    found: list[tuple[str, ...] | None] = []
    for size, axis in zip(shape, axes, strict=True):
        rule = WEIGHTS.get(axis, ()) if axis else ()
        if not rule or used & set(rule) or size % prod(mesh.shape[name] for name in rule):
            found.append(None)
        else:
            used |= set(rule)
            found.append(rule)
    return PartitionSpec(*found)


def shard_params(networks: Module, mesh: Mesh | None) -> Module:
    """Return networks with their weights sharded over a mesh; unchanged without a mesh.

    Weights that are only shapes get the shardings.
    """
    if mesh is None:
        return networks
    graph, params = nnx.split(networks, nnx.Param)
    return nnx.merge(graph, jax.tree.map(put, params, state_sharding(mesh, params)))


def put(leaf: Any, sharding: Any) -> Any:
    """Place an array by a sharding; give a shape the sharding."""
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)
    return jax.device_put(leaf, sharding)


def replicate_params(network: Module) -> Module:
    """Return a network with its weights replicated on every device of the current mesh."""
    if not several_devices():
        return network
    graph, params = nnx.split(network)
    return nnx.merge(graph, jax.lax.with_sharding_constraint(params, PartitionSpec()))
