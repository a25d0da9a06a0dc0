"""Foreign names through a table, both ways."""

import numpy as np
import pytest

from egosim_jax.convert.rules import Rule, assign
from egosim_jax.io.weights import WeightsError
from tests.translation import translate, translate_back

RULES = [
    Rule("head.weight", "head.kernel", "linear"),
    Rule("head.bias", "head.bias"),
    Rule("blocks.*.norm.weight", "blocks.scale"),
    Rule("blocks.*.qk.weight", "blocks.q.kernel", "linear", part=(0, 2)),
    Rule("blocks.*.qk.weight", "blocks.k.kernel", "linear", part=(1, 2)),
]


def foreign(layers=2) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = {"head.weight": (2, 3), "head.bias": (2,)}
    for layer in range(layers):
        shapes[f"blocks.{layer}.norm.weight"] = (3,)
        shapes[f"blocks.{layer}.qk.weight"] = (8, 3)
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def problems(theirs, **more) -> str:
    with pytest.raises(WeightsError) as caught:
        assign(theirs, RULES, **more)
    return "\n".join(caught.value.problems)


def test_a_table_transposes_linears_stacks_layers_and_parts_what_is_fused():
    theirs = foreign()
    ours = translate(theirs, RULES)
    np.testing.assert_array_equal(ours["head.kernel"], theirs["head.weight"].T)
    np.testing.assert_array_equal(ours["blocks.scale"][1], theirs["blocks.1.norm.weight"])
    np.testing.assert_array_equal(ours["blocks.k.kernel"][1], theirs["blocks.1.qk.weight"][4:].T)


def test_a_table_leads_back_to_the_same_tensors():
    theirs = foreign(11)
    back = translate_back(translate(theirs, RULES), RULES)
    assert back.keys() == theirs.keys()
    assert all(np.array_equal(back[name], theirs[name]) for name in theirs)


def test_what_fills_a_path_is_known_before_anything_is_read():
    theirs = foreign(11)
    leaves = assign(theirs, RULES)
    ours = translate(theirs, RULES)
    assert {path: leaf.shape for path, leaf in leaves.items()} == {
        path: tensor.shape for path, tensor in ours.items()
    }
    assert leaves["blocks.scale"].names[10] == "blocks.10.norm.weight"
    assert leaves["blocks.scale"].dtype == np.float32


def test_every_problem_is_listed_at_once():
    theirs = foreign() | {"surprise": np.zeros(1), "head.weight": np.zeros(2)}
    del theirs["head.bias"], theirs["blocks.0.norm.weight"]
    want = {"head.bias": (2,), "blocks.q.kernel": (2, 3, 5), "tail.bias": (1,)}
    listed = problems(theirs, want=want).splitlines()
    expected = [
        "surprise: not in the conversion table",
        "head.weight: has shape (2,); expected a shape that 'linear' maps to head.kernel",
        "head.bias: missing (fills head.bias)",
        "blocks.*.norm.weight: layers [0] are missing",
        "blocks.k.kernel: unexpected, with shape (2, 3, 4)",
        "blocks.q.kernel: has shape (2, 3, 4); expected (2, 3, 5)",
        "tail.bias: missing; expected (1,)",
    ]
    assert len(listed) == len(expected)
    for line in expected:
        assert any(other.startswith(line) for other in listed), line


def test_layers_that_differ_are_named():
    theirs = foreign()
    theirs["blocks.1.norm.weight"] = theirs["blocks.1.norm.weight"].astype(np.float16)
    expected = "blocks.*.norm.weight: the layers are float16 and float32: store one dtype (--dtype)"
    assert problems(theirs) == expected
    theirs["blocks.1.norm.weight"] = np.zeros(5, np.float32)
    assert "blocks.*.norm.weight: the layers differ in shape" in problems(theirs)


def test_a_layer_has_one_name():
    theirs = foreign() | {"blocks.01.norm.weight": np.zeros(3, np.float32)}
    assert problems(theirs) == "blocks.01.norm.weight: not in the conversion table of this network"


def test_an_ignored_tensor_is_no_problem():
    leaves = assign(foreign() | {"extra.0": np.zeros(1)}, RULES, ignore=["extra.*"])
    assert leaves.keys() == {rule.target for rule in RULES}
