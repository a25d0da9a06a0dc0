"""Logical axes and where they lead."""

import jax
import pytest
from flax import nnx
from jax.sharding import PartitionSpec

from egosim_jax import configs
from egosim_jax.generator import Networks
from egosim_jax.sharding import MeshConfig, make_mesh, state_sharding
from egosim_jax.types import InputError


@pytest.fixture(scope="module")
def params() -> nnx.State:
    config = configs.get("egosim_14b")
    return nnx.state(nnx.eval_shape(lambda: Networks(config, rngs=nnx.Rngs(0))), nnx.Param)


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


def test_a_mesh_that_does_not_fit_the_devices_is_refused():
    with pytest.raises(InputError, match=f"does not fit {jax.device_count()} devices"):
        make_mesh(MeshConfig(data=3, fsdp=5))
