"""The umT5 encoder by itself."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from einops import rearrange
from flax import nnx

from egosim_jax.io.weights import fill, flat_shapes
from egosim_jax.models.t5 import relative_buckets
from egosim_jax.models.wan.umt5 import UMT5, SelfAttention, UMT5Config
from egosim_jax.types import InputError

SIZES = dict(vocab=40, dim=32, ffn_dim=48, heads=4, head_dim=8, layers=2)


encode = jax.jit(lambda model, ids, mask: model(ids, mask))


def make(dtype="float32"):
    """An encoder with random weights drawn by NumPy, which spares compiling the initializers."""
    model = nnx.eval_shape(lambda: UMT5(UMT5Config(**SIZES, dtype=dtype), rngs=nnx.Rngs(0)))
    draw = np.random.default_rng(0).normal
    fill(
        model,
        {path: draw(size=shape, scale=0.3) for path, shape in flat_shapes(model).items()},
        dtype="float32",
    )
    return model


@pytest.fixture(scope="module")
def model():
    return make()


def prompts():
    ids = jax.random.randint(jax.random.key(1), (4, 12), 2, SIZES["vocab"])
    return ids, jnp.arange(12) < jnp.array([[12], [7], [3], [1]])


def test_embeddings_after_the_end_of_a_prompt_are_zero(model):
    ids, mask = prompts()
    embeddings = encode(model, ids, mask)
    assert not embeddings[~mask].any()
    assert (jnp.abs(embeddings[mask]).sum(axis=-1) > 0).all()


def test_the_padding_does_not_matter(model):
    ids, mask = prompts()
    other = jnp.where(mask, ids, 1)
    np.testing.assert_array_equal(encode(model, ids, mask), encode(model, other, mask))


def test_a_batch_gives_what_its_prompts_give_one_by_one(model):
    ids, mask = prompts()
    together = encode(model, ids, mask)
    alone = np.concatenate(
        [encode(model, ids[i : i + 1], mask[i : i + 1]) for i in range(len(ids))]
    )
    # float32: matrix products of other shapes sum in another order
    assert np.linalg.norm(together - alone) <= 1e-5 * np.linalg.norm(alone)


def test_each_block_has_its_own_position_biases(model):
    table = model.blocks.attn.position_bias
    assert table.shape == (2, 32, 4)
    assert not np.allclose(table[0], table[1])


def test_buckets_follow_the_formula_of_the_t5_paper():
    def bucket(offset):
        distance, later = abs(offset), 16 if offset > 0 else 0
        if distance < 8:
            return distance + later
        # 8 buckets from 8 to 128 = 8 * 2**4: two an octave, so that the borders are 8 * 2**(k/2)
        return min(8 + math.floor(math.log2((distance / 8) ** 2)), 15) + later

    have = relative_buckets(300, buckets=32, max_distance=128)
    want = [[bucket(key - query) for key in range(300)] for query in range(300)]
    np.testing.assert_array_equal(have, want)


def test_bfloat16_stays_close_to_float32(model):
    ids, mask = prompts()
    want, have = encode(model, ids, mask), encode(make("bfloat16"), ids, mask)
    assert have.dtype == jnp.bfloat16
    # 8 bits of mantissa, rounded a few times a block
    assert np.linalg.norm(have.astype(np.float32) - want) <= 0.03 * np.linalg.norm(want)


def test_every_weight_names_one_logical_axis_a_dimension():
    model = nnx.eval_shape(lambda: UMT5(UMT5Config(**SIZES), rngs=nnx.Rngs(0)))
    for path, leaf in nnx.to_flat_state(nnx.state(model)):
        axes = leaf.get_metadata()["axes"]
        assert len(axes) == len(leaf.shape), path
        assert (axes[0] == "layers") == (path[0] == "blocks"), path


def test_every_weight_receives_a_gradient(model):
    ids, mask = prompts()
    gradients = jax.jit(jax.grad(lambda m: (m(ids, mask)[:, 0] ** 4).sum()))(model)
    for path, gradient in nnx.to_flat_state(nnx.state(gradients)):
        assert jnp.abs(gradient.get_value()).max() > 0, path


def test_scores_start_with_the_variance_that_scaled_attention_has():
    config = UMT5Config(vocab=64, dim=256, ffn_dim=8, heads=4, head_dim=64, layers=1)
    attn = SelfAttention(config, rngs=nnx.Rngs(0))
    x = jax.random.normal(jax.random.key(0), (64, 256))
    q, k = (rearrange(y, "n (h k) -> n h k", h=4) for y in (attn.q(x), attn.k(x)))
    # 16,384 dot products of shared vectors scatter by a few per cent
    assert float(jnp.einsum("nhk,mhk->hnm", q, k).std()) == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize("sizes", [{"buckets": 6}, {"buckets": 0}, {"max_distance": 8}])
def test_buckets_that_leave_no_room_are_refused(sizes):
    with pytest.raises(InputError):
        UMT5Config(**SIZES, **sizes)
