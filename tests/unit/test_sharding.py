"""Logical axes and where they lead."""

import jax
import numpy as np
import pytest
from flax import nnx
from jax.sharding import AbstractMesh, Mesh, PartitionSpec

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.sharding import (
    assemble,
    batch_sharding,
    check_batch,
    make_mesh,
    process_rows,
    row_groups,
    state_sharding,
)
from egosim_jax.types import InputError, MeshConfig
from tests.machines import MACHINES, gpus


@pytest.fixture(scope="module")
def params() -> nnx.State:
    config = configs.get("egosim_14b")
    return nnx.state(Networks.abstract(config), nnx.Param)


def test_every_weight_of_every_network_names_its_axes(params):
    nameless = [
        ".".join(map(str, path))
        for path, leaf in nnx.to_flat_state(params)
        if len(leaf.get_metadata().get("axes", ())) != len(leaf.shape)
    ]
    assert not nameless


def test_the_model_width_is_split_over_fsdp_and_layers_are_not(params):
    placed = state_sharding(make_mesh(MeshConfig()), params)
    spec = placed["dit"]["blocks"]["self_attn"]["q"]["kernel"].get_value().spec
    assert spec == PartitionSpec(None, ("fsdp", "context"), None)


@pytest.mark.parametrize("axis", ["data", "fsdp", "context"])
def test_any_axis_takes_the_devices_that_are_left(axis):
    config = MeshConfig(**{"data": 1, "fsdp": 1, "context": 1, axis: -1})
    assert make_mesh(config).shape[axis] == jax.device_count()
    assert make_mesh(config, jax.devices()[:1]).size == 1


@pytest.mark.parametrize("sizes", [(3, 5, 1), (-1, -1, 1), (0, -1, 1), (-2, 1, 1), (1, -1, 10**6)])
def test_a_mesh_that_does_not_fit_the_devices_is_refused(sizes):
    config = MeshConfig(**dict(zip(("data", "fsdp", "context"), sizes, strict=True)))
    with pytest.raises(
        InputError, match=rf"does not fit {jax.device_count()} devices.*--mesh\.data"
    ):
        make_mesh(config)


def test_a_batch_that_a_mesh_does_not_divide_is_refused():
    mesh = AbstractMesh((2, 2, 2), ("data", "fsdp", "context"))
    check_batch(8, mesh)
    with pytest.raises(InputError, match=r"A batch of 6 .*data 2 x fsdp 2.* Nearest: 8"):
        check_batch(6, mesh)
    with pytest.raises(
        InputError, match=r"Nearest: 16\. Or a number of micro-batches that divides 2"
    ):
        check_batch(8, mesh, grad_accum_steps=4)


def held(machine: str, data: int, context: int, size: int) -> dict[int, tuple[int, ...]]:
    mesh = make_mesh(MeshConfig(data=data, context=context), MACHINES[machine])
    return process_rows(batch_sharding(mesh), size)


@pytest.mark.parametrize(
    ("machine", "data", "context", "rows"),
    [
        ("v5e:4x4", 1, 1, [(0, 1, 6, 15), (2, 3, 4, 5), (7, 12, 13, 14), (8, 9, 10, 11)]),
        ("v6e:4x4", 1, 1, [(0, 1, 6, 15), (2, 3, 4, 5), (7, 12, 13, 14), (8, 9, 10, 11)]),
        ("v6e:4x4", 4, 1, [(0, 1, 4, 5), (2, 3, 6, 7), (8, 9, 12, 13), (10, 11, 14, 15)]),
        ("v5e:4x4", 1, 2, [(0, 1, 2, 3), (8, 9, 10, 11), (4, 5, 6, 7), (12, 13, 14, 15)]),
        ("v5e:8x8", 1, 1, [(0, 1, 8, 9), (16, 17, 24, 25), (32, 33, 40, 41), (48, 49, 56, 57)]),
        ("v5p:4x4x4", 1, 1, [(0, 4, 16, 20), (32, 36, 48, 52), (8, 12, 24, 28), (40, 44, 56, 60)]),
        ("v5p:4x4x4", 4, 1, [(0, 1, 4, 5), (8, 9, 12, 13), (2, 3, 6, 7), (10, 11, 14, 15)]),
        ("h200:16", 1, 1, [range(8), range(8, 16)]),
        ("h200:16", 2, 4, [range(8), range(8, 16)]),
        ("b200:72", 9, 1, [range(n, n + 8) for n in range(0, 72, 8)]),
    ],
)  # fmt: skip
def test_hosts_have_the_rows_of_their_devices(machine, data, context, rows):
    found = held(machine, data, context, len(MACHINES[machine]))
    assert list(found) == sorted({device.process_index for device in MACHINES[machine]})
    assert list(found.values())[: len(rows)] == [tuple(own) for own in rows]


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("context", [1, 2, 4])
def test_every_row_is_held_by_as_many_devices_as_share_a_sample(machine, context):
    devices = MACHINES[machine]
    size = 2 * len(devices) // context
    found = held(machine, 1, context, size)
    groups = row_groups(found)
    assert sorted(row for rows in groups for row in rows) == list(range(size))
    assert sorted(process for group in groups.values() for process in group) == list(found)
    hosts = len(found)
    assert sum(map(len, found.values())) == size * (hosts // len(groups))
    assert all(len(rows) == len(next(iter(groups))) for rows in groups)


def test_processes_may_share_a_part_of_their_rows():
    mesh = make_mesh(MeshConfig(context=2), gpus("NVIDIA H200", 16))
    order = [0, 8, 1, 2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14, 15]
    mixed = Mesh(mesh.devices.ravel()[order].reshape(mesh.devices.shape), mesh.axis_names)
    rows = process_rows(batch_sharding(mixed), 8)
    assert rows == {0: (0, 1, 2, 3, 4), 1: (0, 4, 5, 6, 7)}
    assert row_groups(rows) == {rows[0]: [0], rows[1]: [1]}


def test_rows_of_another_number_are_not_assembled():
    sharding = batch_sharding(make_mesh(MeshConfig(), jax.devices()[:1]))
    batch = {"record": np.arange(4, dtype=np.int32)}
    np.testing.assert_array_equal(assemble(batch, sharding, 4)["record"], batch["record"])
    with pytest.raises(ValueError, match="record has 4 rows; this process holds the 8 rows"):
        assemble(batch, sharding, 8)
