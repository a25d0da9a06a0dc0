"""Laws that the networks obey at any size."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from hypothesis import given, settings
from hypothesis import strategies as st

from egosim_jax import configs
from egosim_jax.models.rope import rotate, rotations

SIZE = (4, 3, 5)
HEAD = 12
offsets = st.tuples(*(st.integers(0, side - 1) for side in SIZE))


@given(offsets, offsets, st.integers(0, 2**32 - 1))
def test_a_product_of_rotated_vectors_depends_on_the_difference_of_positions(first, second, seed):
    rng = np.random.default_rng(seed)
    query, key = (jnp.asarray(rng.normal(size=HEAD), jnp.float32) for _ in range(2))
    table = rotations(*SIZE, HEAD)

    def product(at, other):
        a, b = (
            rotate(x[None, None, None], table[np.ravel_multi_index(p, SIZE)][None])
            for x, p in ((query, at), (key, other))
        )
        return float(jnp.sum(a * b))

    low = np.minimum(first, second)
    moved = product(tuple(first - low), tuple(second - low))
    np.testing.assert_allclose(product(first, second), moved, atol=1e-4)


@cache
def halves():
    """Return encoder and decoder of a small VAE, compiled: functions of a chunk and a cache."""
    config = replace(configs.get("debug").vae, dim=4)
    graph, params = nnx.split(config.build(rngs=nnx.Rngs(0)))

    def compiled(half):
        run = jax.jit(lambda params, x, memory: getattr(nnx.merge(graph, params), half)(x, memory))
        return partial(run, params)

    return compiled("encoder"), compiled("decoder")


def in_chunks(run, x, sizes):
    """Concatenate what a half of the VAE returns for chunks of its input, to the end of it."""
    memory, pieces = None, []
    for chunk in jnp.split(x, np.cumsum(sizes), axis=1):
        if chunk.shape[1]:
            out, memory = run(chunk, memory)
            pieces.append(out)
    return jnp.concatenate(pieces, axis=1)


@pytest.mark.slow
@settings(max_examples=3)
@given(st.sampled_from([(1, 1), (1, 2), (2, 1)]))
def test_any_chunks_of_latents_decode_to_the_same_video(sizes):
    _, decode = halves()
    hidden = jax.random.normal(jax.random.key(0), (1, 3, 2, 1, 16))
    np.testing.assert_allclose(in_chunks(decode, hidden, sizes), decode(hidden, None)[0], atol=1e-5)


@settings(max_examples=3)
@given(st.sampled_from([(1, 4, 4), (1, 4, 8), (1, 8, 4)]))
def test_any_chunks_of_a_video_encode_to_the_same_latents(sizes):
    encode, _ = halves()
    video = jax.random.uniform(jax.random.key(1), (1, 13, 16, 16, 3))
    np.testing.assert_allclose(in_chunks(encode, video, sizes), encode(video, None)[0], atol=1e-5)
