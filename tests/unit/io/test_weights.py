"""Weights: our own format, and foreign names through a table, both ways."""

import os

import numpy as np
import pytest
from flax import nnx

from egosim_jax.io import weights
from egosim_jax.io.weights import Rule, WeightsError
from egosim_jax.models.layers import Linear, RMSNorm, stack
from egosim_jax.types import InputError

RULES = [
    Rule("head.weight", "head.kernel", "linear"),
    Rule("head.bias", "head.bias"),
    Rule("blocks.*.norm.weight", "blocks.scale"),
]


class Net(nnx.Module):
    def __init__(self, *, rngs: nnx.Rngs):
        self.head = Linear(3, 2, axes=("embed", "mlp"), rngs=rngs)
        self.blocks = stack(lambda _: RMSNorm(3, eps=1e-6), 2, rngs=rngs)


def foreign() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = {
        "head.weight": (2, 3),
        "head.bias": (2,),
        "blocks.0.norm.weight": (3,),
        "blocks.1.norm.weight": (3,),
    }
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def test_saved_weights_may_be_half_as_wide(tmp_path):
    net, back = Net(rngs=nnx.Rngs(0)), skeleton()
    weights.save(tmp_path / "net.safetensors", net, dtype="float16")
    weights.load(tmp_path / "net.safetensors", back)
    assert back.head.kernel[...].dtype == np.float16
    np.testing.assert_allclose(back.head.kernel[...], net.head.kernel[...], rtol=1e-3)
    assert net.head.kernel[...].dtype == np.float32


def skeleton() -> Net:
    return nnx.eval_shape(lambda: Net(rngs=nnx.Rngs(0)))


def test_a_saved_network_loads_into_a_skeleton_bit_for_bit(tmp_path):
    net, path = Net(rngs=nnx.Rngs(1)), tmp_path / "net.safetensors"
    weights.save(path, net)
    copy = skeleton()
    weights.load(path, copy)
    np.testing.assert_array_equal(copy.head.kernel[...], net.head.kernel[...])
    assert [file.name for file in tmp_path.iterdir()] == ["net.safetensors"]


def test_a_table_transposes_linears_and_stacks_layers():
    theirs, net = foreign(), skeleton()
    weights.fill(net, weights.translate(theirs, RULES))
    np.testing.assert_array_equal(net.head.kernel[...], theirs["head.weight"].T)
    np.testing.assert_array_equal(net.blocks.scale[...][1], theirs["blocks.1.norm.weight"])


def test_a_table_leads_back_to_the_same_tensors():
    theirs = foreign()
    back = weights.translate_back(weights.translate(theirs, RULES), RULES)
    assert back.keys() == theirs.keys()
    assert all(np.array_equal(back[name], theirs[name]) for name in theirs)


def test_every_unknown_and_missing_tensor_is_listed_at_once():
    theirs = foreign() | {"surprise": np.zeros(1)}
    del theirs["head.bias"], theirs["blocks.0.norm.weight"]
    with pytest.raises(WeightsError) as caught:
        weights.translate(theirs, RULES)
    text = str(caught.value)
    assert len(caught.value.problems) == 3
    assert all(name in text for name in ("surprise", "head.bias", "blocks.*.norm.weight"))


def test_an_ignored_tensor_is_no_problem():
    ours = weights.translate(foreign() | {"extra.0": np.zeros(1)}, RULES, ignore=["extra.*"])
    assert sorted(ours) == ["blocks.scale", "head.bias", "head.kernel"]


def test_weights_of_another_network_are_refused_with_have_and_want(tmp_path):
    net, path = Net(rngs=nnx.Rngs(0)), tmp_path / "net.safetensors"
    net.head = Linear(3, 5, axes=("embed", "mlp"), rngs=nnx.Rngs(0))
    weights.save(path, net)
    with pytest.raises(WeightsError, match=r"head\.kernel: have \(3, 5\), want \(3, 2\)"):
        weights.load(path, skeleton())


def test_a_truncated_file_is_refused(tmp_path):
    path = tmp_path / "net.safetensors"
    weights.save(path, Net(rngs=nnx.Rngs(0)))
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(InputError, match="not a readable safetensors file"):
        weights.load(path, skeleton())


def test_a_missing_file_names_the_option(tmp_path):
    with pytest.raises(InputError, match="--weights"):
        weights.load(tmp_path / "none.safetensors", skeleton())


def test_weights_can_be_read_by_whoever_the_umask_allows(tmp_path):
    umask = os.umask(0o022)
    try:
        weights.save(tmp_path / "a.safetensors", Net(rngs=nnx.Rngs(0)))
    finally:
        os.umask(umask)
    assert (tmp_path / "a.safetensors").stat().st_mode & 0o777 == 0o644
