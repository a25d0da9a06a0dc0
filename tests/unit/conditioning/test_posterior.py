"""Latents drawn from posteriors, and noise on the pixels of the prior."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.conditioning.posterior import EncodingNoise, add_pixel_noise, draw, posterior
from egosim_jax.types import InputError

KEYS = jax.random.split(jax.random.key(0), 2)


class Codec:
    """Moments that are known; latents are halved after a mean of 3."""

    def moments(self, video):
        mean = video[..., :1]
        return mean, jnp.full_like(mean, 2 * np.log(0.5))

    def normalize(self, mean):
        return (mean - 3.0) / 2


def test_mean_and_deviation_are_normalized_as_latents_are():
    video = jnp.arange(24.0).reshape(2, 1, 2, 2, 3)
    mean, std = posterior(Codec(), video)
    np.testing.assert_allclose(mean, (video[..., :1] - 3) / 2)
    np.testing.assert_allclose(std, 0.25, rtol=1e-6)


def test_each_sample_is_drawn_from_its_own_key():
    mean, std = jnp.full((2, 3, 8, 8, 16), 5.0), jnp.full((2, 3, 8, 8, 16), 0.1)
    both = draw(mean, std, KEYS)
    np.testing.assert_array_equal(both[1:], draw(mean[1:], std[1:], KEYS[1:]))
    assert abs(float(both.mean()) - 5) < 0.005
    assert float(both.std()) == pytest.approx(0.1, rel=0.05)
    assert not np.array_equal(both[0], both[1])


def test_black_pixels_get_no_noise():
    video = jnp.zeros((2, 4, 8, 8, 3)).at[:, :, :4].set(-1.0)
    noisy = add_pixel_noise(video, 0.0563, KEYS)
    np.testing.assert_array_equal(noisy[:, :, :4], -1)
    assert float(noisy[:, :, 4:].std()) == pytest.approx(0.0563, rel=0.1)


def test_a_negative_deviation_is_refused():
    with pytest.raises(InputError, match="prior_pixels must be at least 0, not -1"):
        EncodingNoise(prior_pixels=-1.0)
