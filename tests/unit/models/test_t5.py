"""The umT5 encoder by itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from einops import rearrange
from flax import nnx

from egosim_jax.io.weights import fill, flat_shapes
from egosim_jax.models.t5 import Attention, UMT5Config
from egosim_jax.types import InputError

SIZES = dict(vocab=40, dim=32, ffn_dim=48, heads=4, head_dim=8, layers=2)


encode = jax.jit(lambda model, ids, mask: model(ids, mask))


def make(dtype="float32"):
    """An encoder with random weights drawn by NumPy, which spares compiling the initializers."""
    model = nnx.eval_shape(lambda: UMT5Config(**SIZES, dtype=dtype).build(rngs=nnx.Rngs(0)))
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


def test_bfloat16_stays_close_to_float32(model):
    ids, mask = prompts()
    want, have = encode(model, ids, mask), encode(make("bfloat16"), ids, mask)
    assert have.dtype == jnp.bfloat16
    # 8 bits of mantissa, rounded a few times a block
    assert np.linalg.norm(have.astype(np.float32) - want) <= 0.03 * np.linalg.norm(want)


def test_scores_start_with_the_variance_that_scaled_attention_has():
    config = UMT5Config(vocab=64, dim=256, ffn_dim=8, heads=4, head_dim=64, layers=1)
    attn = Attention(config, rngs=nnx.Rngs(0))
    x = jax.random.normal(jax.random.key(0), (64, 256))
    q, k = (rearrange(y, "n (h k) -> n h k", h=4) for y in (attn.q(x), attn.k(x)))
    # 16,384 dot products of shared vectors scatter by a few per cent
    assert float(jnp.einsum("nhk,mhk->hnm", q, k).std()) == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize("sizes", [{"buckets": 6}, {"buckets": 0}, {"max_distance": 8}])
def test_buckets_that_leave_no_room_are_refused(sizes):
    with pytest.raises(InputError):
        UMT5Config(**SIZES, **sizes)
