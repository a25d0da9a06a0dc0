"""CogVideoX as a family: it generates, guides away from the empty prompt and caches it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.configs.model import Networks
from egosim_jax.diffusion import Guidance
from egosim_jax.generation.compiled import CompiledFn
from egosim_jax.generation.encoding import encode_condition, pack
from egosim_jax.generation.generator import Generator
from egosim_jax.testing import random_triplet
from egosim_jax.train.encode import Encoding, example_shapes
from egosim_jax.train.tasks.denoising import Denoising, condition_of
from egosim_jax.types import InputError
from tests.parity.cogvideox_configs.dwm_tiny import CONFIG as TINY


@pytest.fixture(scope="module")
def networks():
    made = Networks.random(TINY, seed=0)
    made.dit.out.kernel[...] = 0.1 * jax.random.normal(jax.random.key(1), (32, 64))
    return made


@pytest.fixture(scope="module")
def condition(networks):
    inputs = pack([random_triplet(TINY.video, seed, observed=True) for seed in range(2)], TINY)
    return CompiledFn(encode_condition, networks)(inputs)


def test_a_prompt_that_is_dropped_is_the_empty_one(networks, condition):
    tokens = TINY.tokenizer.tokenize([""] * 2)
    text = nnx.jit(lambda encoder, *tokens: encoder(*tokens))
    want = text(networks.text, jnp.asarray(tokens.ids), jnp.asarray(tokens.mask))
    np.testing.assert_allclose(condition.drop("text").text, want, atol=1e-6)
    mixed = condition.drop("text", jnp.array([True, False])).text
    np.testing.assert_array_equal(mixed[1], condition.text[1])
    assert np.abs(mixed[0] - condition.text[0]).max() > 0.1


def test_it_generates_and_guidance_leads_away_from_the_empty_prompt(networks):
    triplets = [random_triplet(TINY.video, 0, observed=True)]
    generator = Generator(TINY, networks)
    (clip,) = generator.generate(triplets, [0])
    assert clip.frames.shape == (9, 32, 48, 3)
    same = [replace(triplets[0], prompt="")]
    plain = replace(TINY, guidance=Guidance(scale=1.0))
    want = Generator(plain, networks).latents(same, [0])
    # At an empty prompt both branches are the same, whatever the scale.
    np.testing.assert_allclose(generator.latents(same, [0]), want, atol=1e-4)


def test_cached_clips_hold_the_empty_prompt_that_training_drops_to(networks):
    triplet = random_triplet(TINY.video, 0, observed=True)
    triplet = replace(triplet, target=triplet.prior)
    encoders = Networks(vae=networks.vae, text=networks.text)
    (record,) = Encoding(TINY, encoders)([triplet])
    shapes = example_shapes(TINY, 1)
    assert {name: a.shape for name, a in record.items()} == {
        name: a.shape[1:] for name, a in shapes.items()
    }
    batch = {name: jnp.asarray(a)[None] for name, a in record.items()}
    task = Denoising(model=TINY, dropout=ConditionDropout(text=1.0))
    trained = Networks(dit=networks.dit)
    dropped = task.dropout.apply(condition_of(trained, batch, TINY), jax.random.key(0))
    np.testing.assert_array_equal(dropped.text[0], record["null_text"])
    loss, _ = nnx.jit(task.loss)(trained, batch, task.keys(jax.random.key(0), 1))
    assert np.isfinite(loss)


def test_frames_that_do_not_fill_chunks_are_refused():
    vae = nnx.eval_shape(lambda: TINY.vae.build(rngs=nnx.Rngs(0)))
    with pytest.raises(InputError, match=r"8k\+1 frames. Nearest: 9 or 17"):
        jax.eval_shape(vae.encode, jax.ShapeDtypeStruct((1, 13, 32, 48, 3), jnp.float32))
    with pytest.raises(InputError, match="4 latent frames cannot be decoded"):
        jax.eval_shape(vae.decode, jax.ShapeDtypeStruct((1, 4, 4, 6, 16), jnp.float32))


def test_rounded_products_stay_near_those_of_float32(networks):
    rng = np.random.default_rng(0)
    latents = jnp.asarray(rng.normal(size=(2, *TINY.latent_shape, 49)), jnp.float32)
    text = jnp.asarray(rng.normal(size=(2, 16, 16)), jnp.float32)
    weights, times = nnx.state(networks.dit), jnp.array([100.0, 900.0])

    def loss_and_gradient(**numerics):
        graph = nnx.graphdef(replace(TINY.dit, **numerics).build(rngs=nnx.Rngs(0)))

        def loss(state):
            return (nnx.merge(graph, state)(latents, times, text) ** 2).sum()

        value, slopes = jax.jit(jax.value_and_grad(loss))(weights)
        return value, jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(slopes)])

    want, slope = loss_and_gradient()
    for dtype in ("float32", "bfloat16"):
        have, rounded = loss_and_gradient(dtype=dtype, products="bfloat16")
        # bfloat16 keeps 8 bits: 4e-3 a rounding.
        assert 0 < abs(have - want) < 3e-2 * want
        assert 0 < jnp.linalg.norm(rounded - slope) < 3e-2 * jnp.linalg.norm(slope)
