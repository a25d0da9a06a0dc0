"""CogVideoX's VAE: standardized latents. Its numerics are compared in tests/parity."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.train.tasks.autoencoding import latent_statistics
from tests.parity.cogvideox_configs.dwm_tiny import CONFIG as TINY


@pytest.mark.parametrize("first", [1, 3])
def test_latents_are_decoded_in_chunks_of_the_first_and_then_two(first):
    config = replace(TINY.vae, decode_first=first)
    vae = config.build(rngs=nnx.Rngs(0))
    latents = jax.random.normal(jax.random.key(1), (1, 5, 2, 2, config.z_dim))
    decode = nnx.jit(lambda vae, latents, cache: vae.decoder(latents, cache))
    parts, cache = [], None
    for start, stop in [(0, first), *((k, k + 2) for k in range(first, 5, 2))]:
        part, cache = decode(vae, latents[:, start:stop], cache)
        parts.append(part)
    expected = jnp.concatenate(parts, axis=1)
    assert expected.shape[1] == 17
    whole = nnx.jit(lambda vae: vae.decode_whole(latents))(vae)
    np.testing.assert_allclose(whole, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_standardized_latents_have_power_one_and_decode_to_the_same_video():
    videos = np.random.default_rng(0).integers(0, 256, (2, 9, 16, 16, 3), np.uint8)
    vae = TINY.vae.build(rngs=nnx.Rngs(0))
    for path, leaf in nnx.to_flat_state(nnx.state(vae, nnx.Param)):
        if path[-1] == "bias":  # 0 as built: a bias has to be scaled as well
            key = jax.random.key(len(path))
            leaf.set_value(0.1 * jax.random.normal(key, leaf.get_value().shape))
    graph, _ = nnx.split(vae)
    pixels = jnp.asarray(videos / 127.5 - 1, jnp.float32)

    @jax.jit
    def through(params):
        vae = nnx.merge(graph, params)
        mean, logvar = vae.moments(pixels)
        return mean, logvar, vae.encode(pixels), vae.decode(vae.encode(pixels))

    mean, logvar, _, decoded = through(nnx.state(vae))
    vae.standardize(*latent_statistics(vae, videos))
    new_mean, new_logvar, latents, again = through(nnx.state(vae))
    np.testing.assert_allclose(np.square(latents).mean((0, 1, 2, 3)), 1, rtol=1e-4)
    np.testing.assert_allclose(again, decoded, atol=2e-5)
    # Mean and deviation of the posterior shrink alike.
    ratio = np.asarray(new_mean) / np.asarray(mean)
    np.testing.assert_allclose(np.exp((new_logvar - logvar) / 2), ratio, rtol=1e-3)
