"""Where arrays live: the device mesh, the logical axes of arrays, and the rules between them.

The mesh is data x fsdp x context. Networks do not know it: each weight names its logical axes
(`models/layers.py`), activations are named where they must lie in a certain way (`constrain`), and
the two tables here map them.

    data      copies of the weights, each with samples of its own; with hosts along it, this is HSDP
    fsdp      devices that share a copy of the weights, each with samples of its own
    context   devices that share samples, too, each with a part of the tokens; in self-attention
              each has all tokens of a part of the heads (Ulysses: Jacobs et al. 2023, section 3)

Weights, gradients and optimizer state are split over fsdp and context together, along the model
width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any

import jax
from flax import nnx
from jax.experimental import mesh_utils
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding, PartitionSpec

from egosim_jax.types import InputError, MeshConfig

WEIGHTS: Mapping[str, tuple[str, ...]] = {"embed": ("fsdp", "context")}
"""Logical axis of a weight to mesh axes; an axis that is not listed is never split."""
ACTIVATIONS: Mapping[str, tuple[str, ...]] = {
    "batch": ("data", "fsdp"),
    "tokens": ("context",),
    "heads": ("context",),
}
"""Logical axis of an activation to mesh axes."""


def make_mesh(config: MeshConfig, devices: Sequence[Any] | None = None) -> Mesh:
    """Lay devices out as data x fsdp x context; all of them, if none are given.

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
            "devices, and only one of them may be -1, which takes those that are left. "
            "(--mesh.data, --mesh.fsdp, --mesh.context; in training, after the stage's name)"
        )
    axes = ("data", "fsdp", "context")
    # `jax.make_mesh` would refuse axes that are not whole ones of a TPU's torus.
    laid = mesh_utils.create_device_mesh(shape, devices, allow_split_physical_axes=True)
    return Mesh(laid, axes, axis_types=(AxisType.Auto,) * 3)


def check_batch(size: int, mesh: Mesh | AbstractMesh, accumulate: int = 1) -> None:
    """Raise `InputError` unless data x fsdp can share a batch, each taking its in equal parts."""
    groups = parts("batch", mesh)
    unit = groups * accumulate
    if size % unit:
        in_turn = f", each in {accumulate} parts" if accumulate > 1 else ""
        fix = f"Nearest: {-(-size // unit) * unit}."
        if size % groups == 0:
            fix = f"{fix} Or parts whose number divides {size // groups}."
        raise InputError(
            f"A batch of {size} cannot be shared by a mesh of data {mesh.shape['data']} x fsdp "
            f"{mesh.shape['fsdp']}{in_turn}: it must be a multiple of their product, {unit}. "
            f"{fix} (--batch-size, in training --accumulate, or another mesh: devices along "
            "context share one sample)"
        )


def several_devices() -> bool:
    """Whether what is traced is for a mesh of more than one device."""
    return jax.sharding.get_abstract_mesh().size > 1


def platform() -> str:
    """What a program that is traced will run on: `cpu`, `gpu` or `tpu`."""
    return _device().platform


def device_kind() -> str:
    """The name of the devices that what is traced will run on."""
    return _device().device_kind


def _device() -> Any:
    device = jax.sharding.get_abstract_mesh().abstract_device
    return jax.devices()[0] if device is None else device


def constrain(x: jax.Array, axes: tuple[str | None, ...]) -> jax.Array:
    """Place an activation as its logical axes say; on one device nothing happens."""
    return jax.lax.with_sharding_constraint(x, spec(*axes)) if several_devices() else x


def spec(*axes: str | None) -> PartitionSpec:
    """The mesh axes of an activation's logical axes."""
    return PartitionSpec(*(ACTIVATIONS[axis] if axis else None for axis in axes))


def parts(axis: str, mesh: Mesh | AbstractMesh | None = None) -> int:
    """Into how many parts a mesh, or that of what is traced, splits an axis of activations."""
    mesh = jax.sharding.get_abstract_mesh() if mesh is None else mesh
    return prod(mesh.shape[name] for name in ACTIVATIONS[axis])


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """The sharding of arrays with a leading batch axis."""
    return NamedSharding(mesh, spec("batch"))


def state_sharding(mesh: Mesh | AbstractMesh, tree: Any) -> Any:
    """The sharding of every leaf of a pytree that may hold nnx variables (params, moments).

    A variable is split by the logical axes that it names; other leaves are repeated. An axis
    whose size the mesh axes do not divide is repeated too, so that tiny models run anywhere.
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
    """The rules' mesh axes, each used once, where they divide the array."""
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
