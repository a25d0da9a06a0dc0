"""Logical axes and where they lead."""

import jax
import pytest
from flax import nnx
from jax.sharding import AbstractMesh, PartitionSpec

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.sharding import check_batch, make_mesh, state_sharding
from egosim_jax.types import InputError, MeshConfig


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
