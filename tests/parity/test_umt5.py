"""The umT5 encoder and its name tables against transformers and the released file."""

import jax
import numpy as np
import pytest
import torch
from flax import nnx
from transformers import UMT5Config as TheirConfig
from transformers import UMT5EncoderModel

from egosim_jax.convert.tables import umt5 as table
from egosim_jax.io.weights import fill, flat_shapes
from egosim_jax.models.t5 import UMT5Config, relative_buckets
from tests.translation import translate, translate_back

# Heads x head_dim is not dim, and 40 tokens reach every bucket.
CONFIG = UMT5Config(
    vocab=61, dim=48, ffn_dim=80, heads=4, head_dim=8, layers=3, buckets=8, max_distance=20
)
TOLERANCE = 1e-5
"""Relative L2 in float32: the order of sums over up to 80 terms in 6 residual steps."""


@pytest.fixture(scope="module")
def theirs():
    torch.manual_seed(0)
    model = UMT5EncoderModel(
        TheirConfig(
            vocab_size=CONFIG.vocab,
            d_model=CONFIG.dim,
            d_kv=CONFIG.head_dim,
            d_ff=CONFIG.ffn_dim,
            num_layers=CONFIG.layers,
            num_heads=CONFIG.heads,
            relative_attention_num_buckets=CONFIG.buckets,
            relative_attention_max_distance=CONFIG.max_distance,
            feed_forward_proj="gated-gelu",
        )
    ).eval()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "norm" in name:
                parameter.uniform_(0.5, 1.5)
            elif "relative_attention_bias" in name:
                parameter.normal_()
    return model


@pytest.fixture(scope="module")
def ours(theirs):
    model = nnx.eval_shape(lambda: CONFIG.build(rngs=nnx.Rngs(0)))
    state = {name: tensor.numpy() for name, tensor in theirs.state_dict().items()}
    rules, ignored = table.transformers(CONFIG), table.TABLE.ignored(CONFIG)
    fill(model, translate(state, rules, ignore=ignored))
    return model


def test_embeddings_of_a_padded_batch_are_those_of_transformers(ours, theirs):
    ids = np.random.default_rng(0).integers(0, CONFIG.vocab, (3, 40), np.int32)
    mask = np.arange(40) < np.array([[40], [23], [1]])
    with torch.no_grad():
        want = theirs(torch.tensor(ids), torch.tensor(mask).long()).last_hidden_state.numpy()
    with jax.default_matmul_precision("highest"):
        have = np.asarray(jax.jit(ours)(ids, mask))
    error = np.linalg.norm(have[mask] - want[mask]) / np.linalg.norm(want[mask])
    assert error <= TOLERANCE


@pytest.mark.parametrize(("buckets", "max_distance"), [(32, 128), (8, 20)])
def test_relative_buckets_are_those_of_transformers(theirs, buckets, max_distance):
    attention = theirs.encoder.block[0].layer[0].SelfAttention
    attention.relative_attention_num_buckets = buckets
    attention.relative_attention_max_distance = max_distance
    offsets = torch.arange(600)[None] - torch.arange(600)[:, None]
    want = attention._relative_position_bucket(offsets).numpy()
    have = relative_buckets(600, buckets=buckets, max_distance=max_distance)
    np.testing.assert_array_equal(have, want)
    attention.relative_attention_num_buckets = CONFIG.buckets
    attention.relative_attention_max_distance = CONFIG.max_distance


def test_official_names_and_shapes_are_those_of_the_released_file():
    config = UMT5Config()
    model = nnx.eval_shape(lambda: config.build(rngs=nnx.Rngs(0)))
    full_size = {
        path: np.broadcast_to(np.float32(0), shape) for path, shape in flat_shapes(model).items()
    }
    have = {
        name: tensor.shape for name, tensor in translate_back(full_size, table.wan(config)).items()
    }
    want = {"token_embedding.weight": (256384, 4096), "norm.weight": (4096,)}
    for i in range(24):
        want |= {f"blocks.{i}.norm{n}.weight": (4096,) for n in (1, 2)}
        want |= {f"blocks.{i}.attn.{name}.weight": (4096, 4096) for name in "qkvo"}
        want |= {f"blocks.{i}.ffn.{name}.weight": (10240, 4096) for name in ("gate.0", "fc1")}
        want |= {f"blocks.{i}.ffn.fc2.weight": (4096, 10240)}
        want |= {f"blocks.{i}.pos_embedding.embedding.weight": (32, 64)}
    assert len(want) == 242
    assert have == want


@pytest.mark.parametrize("naming", [table.wan, table.transformers])
def test_translating_there_and_back_gives_every_weight_again(ours, naming):
    rules = naming(CONFIG)
    weights = {
        ".".join(map(str, path)): np.asarray(leaf.get_value())
        for path, leaf in nnx.to_flat_state(nnx.state(ours, nnx.Param))
    }
    again = translate(translate_back(weights, rules), rules)
    assert again.keys() == weights.keys()
    for path, tensor in weights.items():
        np.testing.assert_array_equal(again[path], tensor)
