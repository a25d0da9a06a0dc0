"""Baselines: what the generator is given instead of all conditions."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.conditioning.condition import Condition
from egosim_jax.diffusion import Guidance
from egosim_jax.generation.batch import BatchJob
from egosim_jax.generation.generator import Generator, denoise
from egosim_jax.types import Triplet
from tests.parity.cogvideox_configs.dwm_tiny import CONFIG as DWM_TINY


@pytest.fixture
def triplet():
    hands = np.zeros((2, 4, 6, 3), np.uint8)
    hands[:, 1, 2] = [60, 30, 20]  # 110 in all
    hands[:, 2, 3] = [60, 20, 20]  # 100
    frames = np.full((2, 4, 6, 3), 7, np.uint8)
    return Triplet(
        video_id="a",
        prompt="",
        prior=frames,
        mask=frames[..., 0],
        hands=hands,
        first_frame=frames[0],
    )


class Recorder(Generator):
    """A generator that keeps what it is given."""

    def __init__(self):
        pass

    def generate(self, triplets, seeds, *, without=None):
        self.hands, self.without = triplets[0].hands, without
        return []


@pytest.mark.parametrize(
    ("baseline", "without", "painted"),
    [(None, None, False), ("no_hands", "hands", False), ("hand_mask", None, True)],
)
def test_a_baseline_changes_the_conditions(triplet, tmp_path, baseline, without, painted):
    job = BatchJob(model=configs.get("debug"), out=tmp_path, weights=None, baseline=baseline)
    recorder = Recorder()
    job._clips(recorder, [triplet], [0])
    assert recorder.without == without
    assert (recorder.hands.max() == 255) == painted
    if painted:
        assert recorder.hands[:, 1, 2].tolist() == [[255] * 3] * 2
        assert recorder.hands.sum() == 2 * 3 * 255
        assert recorder.hands.dtype == np.uint8


class Blind:
    """A denoiser that keeps what it is given and predicts that there is no noise."""

    def __init__(self):
        self.seen = []

    def prepare(self, condition, text, image):
        self.condition = condition

    def denoise(self, noisy, t, context):
        self.seen.append((noisy, t))
        return jnp.zeros_like(noisy)


def test_sdedit_takes_the_last_steps_from_the_noised_prior():
    config = replace(DWM_TINY, steps=8, strength=0.75, guidance=Guidance(scale=1.0))
    draw = np.random.default_rng(0).standard_normal
    prior, noise = (jnp.asarray(draw((1, *config.latent_shape, 16), np.float32)) for _ in range(2))
    condition = Condition(
        mask=jnp.zeros((1, *config.latent_shape, 1)),
        prior=prior,
        hands=prior,
        text=jnp.ones((1, 2, 16)),
    )
    dit = Blind()
    with jax.disable_jit():
        denoise(dit, condition, noise, config)
    levels = config.process.timesteps(config.process.times(8)[:-1])
    assert [float(t[0]) for _, t in dit.seen] == levels[2:].tolist()
    signal = np.sqrt(1 - config.process.sigma(config.process.times(8)[2:3]) ** 2)
    want = signal * prior + np.sqrt(1 - signal**2) * noise
    np.testing.assert_allclose(dit.seen[0][0], want, atol=1e-5)
    # Nothing is said of the prior: latents 0, and a mask that asks to generate everything.
    at = {name: config.layout.slice(name) for name in ("mask", "prior", "hands")}
    shift = config.layout.slice("noisy").stop
    for name in ("mask", "prior"):
        part = dit.condition[..., at[name].start - shift : at[name].stop - shift]
        assert not part.any(), name
    assert dit.condition[..., at["hands"].start - shift :].any()
