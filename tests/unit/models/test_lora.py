"""Low-rank additions: their names, layers and first values."""

from math import prod

import numpy as np
import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.models.layers import Linear, LowRankParam
from egosim_jax.models.lora import Delta, from_tensors, full_weights, start, tensors


def test_summands_of_layers_that_are_called_up_and_down_are_read_back():
    deltas = {
        path: Delta(down=np.full((3, 1), number), up=np.full((1, 2), -number))
        for number, path in zip((1.0, 2.0, 3.0), ("mlp.down", "mlp.up", "attention.q"), strict=True)
    }
    back = from_tensors(tensors(deltas))
    assert back.keys() == deltas.keys()
    for path, delta in deltas.items():
        assert (back[path].down == delta.down).all()
        assert (back[path].up == delta.up).all()


def test_the_first_values_are_uniform_as_pefts():
    """Kaiming's, with a = sqrt(5): ± 1 / sqrt(in), whose deviation is that bound / sqrt(3)."""
    network = nnx.Dict(a=Linear(64, 8, axes=(None, None), rngs=nnx.Rngs(0)))
    start(network, 32, targets=("*",), rngs=nnx.Rngs(1))
    down, up = network.a.low_rank.down[...], network.a.low_rank.up[...]
    assert 0.99 / 8 < np.abs(down).max() <= 1 / 8
    assert float(down.std()) == pytest.approx(1 / 8 / 3**0.5, rel=0.05)
    assert abs(float(down.mean())) < 0.01
    np.testing.assert_array_equal(up, 0)


@pytest.mark.parametrize(
    ("name", "modules", "weights"),
    [("dwm_cogvideox_5b", 168, 66_060_288), ("dwm_wan_14b", 488, 364_580_864)],
)
def test_a_lora_of_dwm_has_the_layers_of_its_release(name, modules, weights):
    """At rank 64; by shapes alone, of the full size."""
    dit = configs.get(name).dit

    def make():
        network = dit.build(rngs=nnx.Rngs(0))
        patterns = {"targets": dit.lora_targets, "also_train": dit.also_train}
        start(network, 64, **patterns, rngs=nnx.Rngs(1))
        return network

    network = nnx.eval_shape(make)
    leaves = nnx.to_flat_state(nnx.state(network, LowRankParam))
    shapes = {path: leaf.get_value().shape for path, leaf in leaves}
    assert sum(map(prod, shapes.values())) == weights
    assert sum(prod(s[:-2]) for path, s in shapes.items() if path[-1] == "down") == modules
    assert full_weights(network, dit.also_train).keys() == {"patch.kernel", "patch.bias"}
