"""The video transformer: sizes, the split between context and step, precision, bad input."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.models.wan.dit import WanDiT, WanDiTConfig
from egosim_jax.types import InputError

TINY = WanDiTConfig(dim=48, heads=2, ffn_dim=64, layers=2, text_dim=20, image_dim=12)
REORDERED = 1e-5
"""Relative L2 between programs that add the same float32 numbers in another order."""
TIMES = jnp.array([3.5, 250, 500, 1000])


def abstract(config):
    return nnx.eval_shape(lambda: WanDiT(config, rngs=nnx.Rngs(0)))


@cache
def new_weights():
    model = nnx.jit(lambda: WanDiT(TINY, rngs=nnx.Rngs(0)))()
    return nnx.state(model)


@cache
def weights():
    """Weights whose head, zero at initialization, is drawn too."""
    state = jax.tree.map(lambda x: x, new_weights())
    head = state["head"]["linear"]["kernel"]
    head.set_value(jnp.cos(jnp.arange(head.size, dtype=jnp.float32)).reshape(head.shape))
    return state


@cache
def compiled(config, method="__call__"):
    """A method of the network as a function of weights and inputs."""
    graph, _ = nnx.split(abstract(config))
    return jax.jit(lambda state, *given: getattr(nnx.merge(graph, state), method)(*given))


def inputs(config, batch=4):
    rng = np.random.default_rng(0)

    def draw(*shape):
        return jnp.asarray(rng.standard_normal(shape), jnp.float32)

    latents, text = draw(batch, 2, 4, 6, config.in_channels), draw(batch, 7, config.text_dim)
    image = draw(batch, 5, config.image_dim) if config.image_dim else None
    return latents, TIMES[:batch], text, image


def relative(have, want):
    return np.linalg.norm(have - want) / np.linalg.norm(want)


@pytest.mark.parametrize(
    ("config", "parameters"),
    [
        (WanDiTConfig(), 16_395_206_464),
        (WanDiTConfig(in_channels=36), 16_394_878_784),
        (WanDiTConfig(in_channels=16, image_dim=None), 14_288_491_584),
    ],
)
def test_published_shapes_have_their_parameter_counts(config, parameters):
    state = nnx.state(abstract(config), nnx.Param)
    assert sum(leaf.size for leaf in jax.tree.leaves(state)) == parameters


def test_a_new_network_answers_zero():
    velocity = compiled(TINY)(new_weights(), *inputs(TINY))
    assert velocity.shape == (4, 2, 4, 6, 16)
    assert not np.any(velocity)


def test_blocks_are_initialized_differently():
    kernel = new_weights()["blocks"]["mlp"]["up"]["kernel"][...]
    assert not np.allclose(kernel[0], kernel[1])


def test_one_context_serves_every_step():
    latents, t, text, image = inputs(TINY)
    context = compiled(TINY, "prepare")(weights(), latents[..., 16:], text, image)
    for step in (0, 1):
        noisy, now = latents[..., :16] * (1 - step / 2), t * (1 - step / 2)
        whole = jnp.concatenate([noisy, latents[..., 16:]], axis=-1)
        have = compiled(TINY, "denoise")(weights(), noisy, now, context)
        want = compiled(TINY)(weights(), whole, now, text, image)
        assert relative(have, want) <= REORDERED


def loss_of(config):
    graph, _ = nnx.split(abstract(config))
    given = inputs(config)
    return lambda state: jnp.square(nnx.merge(graph, state)(*given)).mean()


@cache
def gradients(config):
    return jax.tree.leaves(jax.jit(jax.grad(loss_of(config)))(weights()))


@pytest.mark.parametrize("remat", ["products", "projections", "attention", "full", "offload"])
def test_gradients_do_not_depend_on_what_is_recomputed(remat):
    recomputed = gradients(replace(TINY, remat=remat))
    for have, want in zip(recomputed, gradients(TINY), strict=True):
        assert np.linalg.norm(have - want) <= REORDERED * np.linalg.norm(want)


def kept_shapes(config):
    """Return the residuals that the forward pass hands to the backward pass."""
    pull = jax.eval_shape(lambda state: jax.vjp(loss_of(config), state)[1], weights())
    return [leaf.shape for leaf in jax.tree.leaves(pull) if leaf.ndim]


def test_remat_of_all_but_attention_keeps_its_output_and_log_sum():
    kept = kept_shapes(replace(TINY, remat="attention"))
    for shape in kept_shapes(replace(TINY, remat="full")):
        kept.remove(shape)
    heads, batch, tokens, head_dim = 2, 4, 12, 24
    output, log_sum = (heads, batch, tokens, head_dim), (heads, batch, tokens, 1)
    assert sorted(kept) == sorted([(TINY.layers, *output), (TINY.layers, *log_sum)])


def test_bfloat16_stays_near_float32_and_answers_in_float32():
    want = compiled(TINY)(weights(), *inputs(TINY))
    have = compiled(replace(TINY, dtype="bfloat16"))(weights(), *inputs(TINY))
    assert have.dtype == jnp.float32
    # bfloat16 keeps 8 bits: 4e-3 a rounding.
    assert relative(have, want) < 3e-2
    rounded = compiled(replace(TINY, products="bfloat16"))(weights(), *inputs(TINY))
    assert 0 < relative(rounded, want) < relative(have, want)


@pytest.mark.parametrize("remat", ["none", "products"])
def test_gradients_of_rounded_products_stay_near_those_of_float32(remat):
    rounded = gradients(replace(TINY, products="bfloat16", remat=remat))
    both = [np.concatenate([np.ravel(x) for x in leaves]) for leaves in (rounded, gradients(TINY))]
    assert 0 < relative(*both) < 3e-2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"in_channels": 15}, "in_channels 15"),
        ({"heads": 5}, "5 heads"),
        ({"dim": 8}, "at least 6"),
        ({"freq_dim": 3}, "freq_dim"),
        ({"layers": 0}, "layers"),
        ({"attention": "cudnn"}, "bfloat16"),
    ],
)
def test_a_config_that_cannot_work_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        replace(TINY, **change)


@pytest.mark.parametrize(
    ("change", "shape", "has_image", "message"),
    [
        ({}, (4, 2, 4, 6, 20), True, "20 channels"),
        ({}, (4, 2, 5, 6, 36), True, "5 x 6"),
        ({}, (4, 2, 4, 6, 36), False, "not given"),
        ({"image_dim": None}, (4, 2, 4, 6, 36), True, "Omit them"),
    ],
)
def test_inputs_that_do_not_fit_are_refused(change, shape, has_image, message):
    _, _, text, image = inputs(TINY)
    network = abstract(replace(TINY, **change))
    with pytest.raises(InputError, match=message):
        network.prepare(jnp.zeros(shape), text, image if has_image else None)
