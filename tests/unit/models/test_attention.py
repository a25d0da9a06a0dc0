"""Attention against the textbook formula in float64."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.models import attention as module
from egosim_jax.models import flash
from egosim_jax.models.attention import attention, keep_attention

ROUNDING = 2e-6
"""Absolute, of float32 sums over at most 7 keys or 8 channels of order 1."""


def draw(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape)


def formula(q, k, v, scale):
    scores = np.einsum("bnhk,bmhk->bhnm", q, k) * scale
    weights = np.exp(scores - scores.max(-1, keepdims=True))
    weights /= weights.sum(-1, keepdims=True)
    return np.einsum("bhnm,bmhk->bnhk", weights, v)


def inputs(keys):
    return draw(2, 5, 3, 8), draw(2, keys, 3, 8, seed=1), draw(2, keys, 3, 8, seed=2)


@pytest.fixture(params=[1, 2, 3], ids="{} heads fit".format)
def heads_at_once(request, monkeypatch):
    """Scores of so many of the three heads fit. Two do not divide three: then one by one."""
    monkeypatch.setattr(module, "SCORES", request.param * 4 * 2 * 5 * 7)


@pytest.mark.usefixtures("heads_at_once")
@pytest.mark.parametrize("keys", [5, 7])
@pytest.mark.parametrize("scale", [None, 1.0])
def test_attention_is_the_softmax_average_of_the_values(keys, scale):
    q, k, v = inputs(keys)
    have = attention(*map(jnp.float32, (q, k, v)), scale=scale)
    want = formula(q, k, v, 8**-0.5 if scale is None else scale)
    np.testing.assert_allclose(have, want, rtol=0, atol=ROUNDING)


def test_scores_of_ten_thousand_do_not_overflow():
    q, k, v = (100 * x for x in inputs(5))
    have = attention(*map(jnp.float32, (q, k, v)))
    np.testing.assert_allclose(have, formula(q, k, v, 8**-0.5), rtol=0, atol=1e-1)


@pytest.mark.usefixtures("heads_at_once")
@pytest.mark.parametrize("argument", [0, 1, 2])
def test_gradients_are_finite_differences_of_the_formula(argument):
    arrays, g = list(inputs(7)), draw(2, 5, 3, 8, seed=3)
    direction = draw(*arrays[argument].shape, seed=4)

    def value(step):
        moved = list(arrays)
        moved[argument] = arrays[argument] + step * direction
        return (formula(*moved, 8**-0.5) * g).sum()

    want = (value(1e-5) - value(-1e-5)) / 2e-5
    _, pull = jax.vjp(attention, *map(jnp.float32, arrays))
    have = (np.asarray(pull(jnp.float32(g))[argument], np.float64) * direction).sum()
    np.testing.assert_allclose(have, want, rtol=1e-5)


def test_a_bias_is_added_to_the_scores():
    q, k, v = inputs(7)
    bias = np.where(np.arange(7) == 3, 0.0, -1e9).reshape(1, 1, 1, 7).repeat(5, 2).repeat(3, 1)
    have = attention(*map(jnp.float32, (q, k, v)), bias=jnp.float32(bias))
    np.testing.assert_allclose(have, np.repeat(v[:, 3:4], 5, 1), rtol=0, atol=ROUNDING)


def value_and_gradients(attend, q, k, v):
    """Return a sum whose parts count differently."""
    weights = jnp.float32(draw(*q.shape, seed=3))
    return jax.value_and_grad(lambda *x: (weights * attend(*x)).sum(), argnums=(0, 1, 2))(q, k, v)


@pytest.mark.parametrize(("queries", "keys"), [(128, 128), (200, 200), (200, 257), (1280, 1280)])
def test_splash_is_the_same_as_xla(queries, keys):
    shapes = [(1, tokens, 2, 128) for tokens in (queries, keys, keys)]
    arrays = [jnp.float32(draw(*shape, seed=n)) for n, shape in enumerate(shapes)]
    have, want = (
        value_and_gradients(partial(attention, kernel=kernel), *arrays)
        for kernel in ("splash", "xla")
    )
    for a, b in zip(jax.tree.leaves(have), jax.tree.leaves(want), strict=True):
        assert np.linalg.norm(a - b) <= 1e-5 * np.linalg.norm(b)


@pytest.mark.parametrize(("tokens", "length", "block"), [(24960, 24960, 640), (25000, 25088, 896)])
def test_splash_pads_as_little_as_it_can(tokens, length, block):
    assert flash._blocks(tokens) == (length, block)


@pytest.mark.parametrize("keys", [7, 8, 257])
def test_keys_that_are_added_for_cudnn_change_nothing(keys):
    q, k, v = inputs(keys)
    arrays = list(map(jnp.float32, (q, k, v)))
    padded = partial(flash.cudnn, scale=8**-0.5, implementation="xla")
    np.testing.assert_allclose(padded(*arrays), formula(q, k, v, 8**-0.5), rtol=0, atol=ROUNDING)
    have, want = (value_and_gradients(attend, *arrays) for attend in (padded, attention))
    for a, b in zip(jax.tree.leaves(have), jax.tree.leaves(want), strict=True):
        assert np.linalg.norm(a - b) <= 1e-5 * np.linalg.norm(b)


@pytest.mark.parametrize(
    ("platform", "kind", "dtype", "size", "kernel"),
    [
        ("cpu", "cpu", "float32", 128, "xla"),
        ("gpu", "NVIDIA B200", "bfloat16", 128, "cudnn"),
        ("gpu", "NVIDIA H100 80GB HBM3", "bfloat16", 128, "hopper"),
        ("gpu", "NVIDIA H200", "bfloat16", 128, "hopper"),
        ("gpu", "NVIDIA H200", "float32", 128, "xla"),
        ("gpu", "NVIDIA H200", "bfloat16", 36, "xla"),
        ("tpu", "TPU v5", "bfloat16", 128, "splash"),
        ("tpu", "TPU v5", "float32", 24, "xla"),
    ],
)
def test_each_device_has_its_kernel(platform, kind, dtype, size, kernel, monkeypatch):
    monkeypatch.setattr(module, "platform", lambda: platform)
    monkeypatch.setattr(module, "device_kind", lambda: kind)
    assert module._best(jnp.zeros((1, 2, 3, size), dtype)) == kernel


@pytest.mark.usefixtures("cudnn_version")
@pytest.mark.parametrize(
    ("queries", "keys", "size", "dtype", "fits"),
    [
        (24960, 24960, 128, "bfloat16", True),
        (3120, 24960, 128, "bfloat16", False),  # queries are taken 128 at a time
        (24960, 257, 128, "bfloat16", False),
        (24960, 512, 128, "bfloat16", False),  # too few keys to gain by it
        (1024, 1024, 64, "float16", True),
        (1024, 1024, 96, "bfloat16", False),
    ],
)
def test_the_hopper_kernel_takes_whole_tiles_and_leaves_the_rest_to_cudnn(
    queries, keys, size, dtype, fits
):
    # Traced, not run.
    q, k = (jax.ShapeDtypeStruct((1, n, 2, size), dtype) for n in (queries, keys))
    program = str(jax.make_jaxpr(partial(attention, kernel="hopper"))(q, k, k))
    assert ("hopper_attention" in program) is fits
    assert ("dot_product_attention_fwd" in program) is not fits


@pytest.mark.usefixtures("cudnn_version")
@pytest.mark.parametrize("kernel", ["xla", "cudnn", "splash"])
def test_the_checkpoint_policy_keeps_output_and_log_sum_of_self_attention(kernel):
    # The kernel is traced, not run.
    video = jax.ShapeDtypeStruct((2, 64, 4, 128), jnp.bfloat16)
    text = jax.ShapeDtypeStruct((2, 32, 4, 128), jnp.bfloat16)

    def block(q, k, v, text_k, text_v):
        out = attention(jnp.sin(q), k, v, kernel=kernel)
        return attention(jnp.cos(out), text_k, text_v, kernel=kernel).sum()

    def kept(policy):
        remat = jax.checkpoint(block, policy=policy)
        pull = jax.eval_shape(lambda *x: jax.vjp(remat, *x)[1], video, video, video, text, text)
        # Splash also keeps what it knows of its mask, which is small.
        return sorted(leaf.size for leaf in jax.tree.leaves(pull) if leaf.size > 128)

    arguments = [2 * 32 * 4 * 128] * 2 + [2 * 64 * 4 * 128] * 3
    log_sum, output = 2 * 64 * 4, 2 * 64 * 4 * 128
    if kernel == "splash":  # which pads to its lanes
        log_sum, output = 2 * log_sum, 2 * output
    assert kept(None) == sorted(arguments)
    assert kept(keep_attention) == sorted([*arguments, log_sum, output])
