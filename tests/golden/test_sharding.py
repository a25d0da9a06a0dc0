"""Shards of every weight. To accept a change: `python -m tests.golden.test_sharding`."""

from collections.abc import Iterator
from pathlib import Path

from flax import nnx
from jax.sharding import AbstractMesh

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.sharding import state_sharding

GOLDEN = Path(__file__).with_name("sharding.txt")
MESHES = ((1, 8, 1), (4, 2, 1), (1, 4, 2))
"""Data, fsdp, context."""


def dump() -> Iterator[str]:
    """A line for each weight: its shape, and the shape of a device's part on each mesh."""
    for name in ("egosim_14b", "debug"):
        networks = Networks.abstract(configs.get(name))
        params = nnx.state(networks, nnx.Param)
        meshes = [AbstractMesh(shape, ("data", "fsdp", "context")) for shape in MESHES]
        placed = [dict(nnx.to_flat_state(state_sharding(mesh, params))) for mesh in meshes]
        yield f"{name}: on one device, on data x fsdp x context = {', '.join(map(str, MESHES))}"
        for path, leaf in nnx.to_flat_state(params):
            parts = [shardings[path].get_value().shard_shape(leaf.shape) for shardings in placed]
            yield f"  {'.'.join(map(str, path))}  {'  '.join(map(str, [leaf.shape, *parts]))}"


def test_every_weight_is_sharded_as_before():
    assert list(dump()) == GOLDEN.read_text("utf-8").splitlines()


if __name__ == "__main__":
    GOLDEN.write_text("\n".join(dump()) + "\n", encoding="utf-8")
