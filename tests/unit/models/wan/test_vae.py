"""The video VAE by itself: chunks, causality, latent statistics, gradients, bad input."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.io.weights import fill, flat_shapes
from egosim_jax.models.wan.vae import WanVAE, WanVAEConfig
from egosim_jax.types import InputError

SIZES = dict(dim=4, z_dim=2, res_blocks=1, latent_mean=(0.3, -0.2), latent_std=(0.5, 2.0))
REORDERED = 1e-5
"""Relative L2 between programs that add the same float32 numbers in another order."""
QUICK = {"xla_backend_optimization_level": 0}
"""Compiler options: the arrays are so small that compiling is what takes time."""


def make(dtype="float32"):
    """A VAE with random weights: kernels that keep the variance, gains around one."""
    vae = nnx.eval_shape(lambda: WanVAE(WanVAEConfig(**SIZES, dtype=dtype), rngs=nnx.Rngs(0)))
    rng = np.random.default_rng(0)

    def draw(path, shape):
        if path.endswith("kernel"):
            return rng.normal(scale=np.prod(shape[:-1]) ** -0.5, size=shape)
        return rng.uniform(0.5, 1.5, shape) - path.endswith("bias")

    weights = {path: draw(path, shape) for path, shape in flat_shapes(vae).items()}
    fill(vae, weights, dtype="float32")
    return vae


@pytest.fixture(scope="module")
def vae():
    return make()


def run(vae, method, x):
    """Call a method, or encode in one pass."""
    if method == "encode_whole":
        return vae.normalize(vae.moments(x)[0])
    return getattr(vae, method)(x)


@cache
def compiled(method, dtype="float32"):
    """A method of `make()` as one program of weights and input."""
    graph, _ = nnx.split(make(dtype))
    return jax.jit(lambda state, x: run(nnx.merge(graph, state), method, x), compiler_options=QUICK)


def call(vae, method, x):
    return compiled(method)(nnx.state(vae), x)


FRAMES, LATENT_FRAMES = 13, 4


def video_of(frames=FRAMES, seed=0):
    uniform = np.random.default_rng(seed).uniform
    return jnp.array(uniform(-1, 1, (2, frames, 16, 24, 3)), jnp.float32)


def latents_of(frames=LATENT_FRAMES):
    return jnp.array(np.random.default_rng(0).normal(size=(2, frames, 2, 3, 2)), jnp.float32)


def relative(have, want):
    return np.linalg.norm(have - want) / np.linalg.norm(want)


def test_encoding_in_groups_of_frames_is_encoding_the_whole_clip(vae):
    have, want = (call(vae, method, video_of()) for method in ("encode", "encode_whole"))
    assert have.shape == (2, LATENT_FRAMES, 2, 3, 2)
    assert relative(have, want) <= REORDERED


def test_decoding_frame_by_frame_is_decoding_the_whole_clip_clipped(vae):
    have = call(vae, "decode", latents_of())
    whole = call(vae, "decode_whole", vae.denormalize(latents_of()))
    assert have.shape == (2, FRAMES, 16, 24, 3)
    assert (jnp.abs(whole) > 1).any()
    assert relative(have, jnp.clip(whole, -1, 1)) <= REORDERED


def test_a_latent_frame_sees_none_of_the_later_frames(vae):
    mixed = jnp.concatenate([video_of()[:, :5], video_of(seed=1)[:, 5:]], axis=1)
    have, want = (call(vae, "encode_whole", video) for video in (mixed, video_of()))
    np.testing.assert_array_equal(have[:, :2], want[:, :2])
    assert (have[:, 2:] != want[:, 2:]).all()


@pytest.mark.parametrize(
    ("method", "short", "long"),
    [("encode", video_of(), video_of(41)), ("decode", latents_of(), latents_of(11))],
)
def test_a_longer_clip_needs_more_memory_for_its_pixels_only(vae, method, short, long):
    def temporary(given):
        program = compiled(method).lower(nnx.state(vae), given).compile()
        return program.memory_analysis().temp_size_in_bytes

    pixels = video_of(41).nbytes - video_of().nbytes
    assert temporary(long) - temporary(short) <= 3 * pixels


@pytest.mark.slow
def test_reconstruction_trains_every_weight(vae):
    graph, state = nnx.split(vae)

    def loss(state, video):
        vae = nnx.merge(graph, state)
        mean, logvar = vae.moments(video)
        return jnp.square(vae.decode_whole(mean) - video).mean() + jnp.exp(logvar).mean()

    gradient = jax.jit(jax.grad(loss), compiler_options=QUICK)(state, video_of(5))
    for path, leaf in nnx.to_flat_state(gradient):
        assert jnp.isfinite(leaf[...]).all(), path
        assert leaf[...].any(), path


def test_bfloat16_stays_near_float32(vae):
    have = compiled("moments", "bfloat16")(nnx.state(vae), video_of())
    for mine, want in zip(have, call(vae, "moments", video_of()), strict=True):
        assert relative(mine, want) <= 0.05  # 2^-9 of rounding in each of some 20 steps


@pytest.mark.parametrize("method", ["encode", "decode"])
def test_bfloat16_networks_answer_in_float32(vae, method):
    given = video_of() if method == "encode" else latents_of()
    answer = jax.eval_shape(compiled(method, "bfloat16"), nnx.state(vae), given)
    assert answer.dtype == jnp.float32


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((1, 6, 16, 16, 3), "4k+1"),
        ((1, 5, 16, 20, 3), "multiples of 8"),
    ],
)
@pytest.mark.parametrize("method", ["encode", "moments"])
def test_a_video_that_does_not_fit_the_strides_is_refused(vae, method, shape, words):
    with pytest.raises(InputError, match=words.replace("+", r"\+")):
        getattr(vae, method)(jnp.zeros(shape))
    with pytest.raises(InputError, match=r"A video of uint8 cannot be encoded.*127.5 - 1"):
        vae._check(jnp.zeros((1, 5, 16, 16, 3), jnp.uint8))  # with which the methods begin


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dim_mult": (1, 2, 4)}, "3 levels"),
        ({"temporal_downsample": (True, True, True)}, "stride of 4 frames"),
        ({"z_dim": 8}, "latent_mean has 2 entries for 8"),
        ({"latent_std": (1.0,)}, "latent_std has 1 entries for 2"),
    ],
)
def test_sizes_that_do_not_fit_each_other_are_refused(change, words):
    with pytest.raises(InputError, match=words):
        WanVAEConfig(**(SIZES | change))


@pytest.mark.slow
def test_an_untrained_vae_already_separates_dark_from_bright_everywhere_in_the_clip():
    config = WanVAEConfig(
        dim=8, z_dim=4, res_blocks=1, latent_mean=(0.0,) * 4, latent_std=(1.0,) * 4
    )
    gray = jnp.linspace(-1, 1, 9)
    videos = jnp.broadcast_to(gray[:, None, None, None, None], (9, 5, 16, 16, 3))
    decoded = jax.jit(
        lambda rngs: (vae := WanVAE(config, rngs=rngs)).decode_whole(vae.moments(videos)[0]),
        compiler_options=QUICK,
    )
    for seed in range(3):
        values = np.asarray(decoded(nnx.Rngs(seed))).reshape(9, -1)
        correlation = np.corrcoef(np.concatenate([gray[None], values.T]))[0, 1:]
        assert np.median(correlation) > 0.8


def test_standardized_latents_have_the_moments_asked_for_and_decode_to_the_same_video(vae):
    mean, std = np.array([1.5, -0.7], np.float32), np.array([3.0, 0.2], np.float32)
    ours = nnx.clone(vae)
    ours.standardize(mean, std)
    before, after = (call(each, "moments", video_of()) for each in (vae, ours))
    np.testing.assert_allclose(after[0], (before[0] - mean) / std, atol=1e-5)
    np.testing.assert_allclose(after[1], before[1] - 2 * np.log(std), atol=1e-5)
    have = call(ours, "decode_whole", latents_of())
    assert relative(have, call(vae, "decode_whole", latents_of() * std + mean)) <= REORDERED
