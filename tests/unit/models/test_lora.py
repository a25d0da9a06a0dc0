"""Low-rank additions: their names, layers and first values."""

from math import prod

import numpy as np
import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.models.layers import Linear, LowRankParam
from egosim_jax.models.lora import (
    Delta,
    Value,
    apply,
    check_further,
    deltas_of,
    from_tensors,
    full_weights,
    start,
    state_of,
    tensors,
    trained,
)
from egosim_jax.types import InputError


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


class Net(nnx.Module):
    def __init__(self):
        self.patch = Linear(3, 4, axes=(None, None), rngs=nnx.Rngs(0))
        self.q = Linear(4, 5, axes=(None, None), rngs=nnx.Rngs(1))
        self.k = Linear(4, 5, axes=(None, None), rngs=nnx.Rngs(2))


def training(rank=2):
    """The weights that a LoRA of `q` and `k` trains, with the patch projection in full."""
    networks = nnx.Dict(dit=Net())
    patterns = {"targets": ("q", "k"), "also_train": ("patch.*",)}
    start(networks.dit, rank, **patterns, rngs=nnx.Rngs(3))
    return networks, nnx.state(networks, trained(("patch.*",)))


def low_rank(rank=2, wide=4):
    rng = np.random.default_rng(0)
    down, up = (rng.normal(size=s).astype(np.float32) for s in ((wide, rank), (rank, 5)))
    return Delta(down=down, up=up)


@pytest.mark.parametrize("rank", [2, 3])
def test_a_lora_is_trained_further_with_its_weights_in_full(rank):
    networks, abstract = training(rank)
    diff, value = np.full((3, 4), 0.5, np.float32), np.full(4, 7.0, np.float32)
    kernel = networks.dit.patch.kernel[...]
    changes = {"q": low_rank(), "patch.kernel": diff, "patch.bias": Value(array=value)}
    check_further(changes, abstract)
    nnx.update(networks, state_of(changes, abstract, abstract))
    now = deltas_of(networks.dit)
    np.testing.assert_array_equal(now["q"].down[:, :2], changes["q"].down)
    np.testing.assert_array_equal(now["q"].up[:2], changes["q"].up)
    np.testing.assert_array_equal(networks.dit.patch.kernel[...], kernel + diff)
    np.testing.assert_array_equal(networks.dit.patch.bias[...], value)
    assert not now["q"].up[2:].any()
    assert now["q"].down[:, 2:].all()  # or it would never learn
    assert now["k"].down.all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q": low_rank(rank=3)}, "q: has rank 3; the training has 2 .--rank"),
        ({"q": low_rank(wide=6)}, r"q: has shapes \(6, 2\)"),
        ({"patch": low_rank()}, "patch: is not trained here"),
        ({"q.kernel": np.zeros((4, 5))}, "q.kernel: is not trained here"),
        ({"patch.bias": np.zeros(9)}, r"patch.bias: has shape \(9,\)"),
    ],
)
def test_a_lora_that_cannot_be_trained_further_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        check_further(changes, training()[1])


def test_patterns_and_ranks_that_train_nothing_are_refused():
    for rank, patterns, message in (
        (0, {"targets": ("q",)}, "at least 1"),
        (2, {"targets": ("layers.*",)}, r"none matches .*layers\.\*.*lora_targets"),
        (2, {"targets": ("q",), "also_train": ("input.*",)}, r"none of input\.\*"),
    ):
        with pytest.raises(InputError, match=message):
            start(Net(), rank, **patterns, rngs=nnx.Rngs(0))


def test_a_pair_for_a_layer_that_is_not_linear_is_refused():
    network = nnx.Dict(conv=nnx.Dict(kernel=nnx.Param(np.ones((2, 3), np.float32))))
    delta = Delta(down=np.ones((2, 1), np.float32), up=np.ones((1, 3), np.float32))
    with pytest.raises(InputError, match="conv: is not a linear layer"):
        apply(network, {"conv": delta})
