"""The generator: batches, seeds, the cache, and what it refuses."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.conditioning.condition import Condition
from egosim_jax.configs.model import Networks
from egosim_jax.diffusion import (
    DDIM,
    DPMSolver,
    Guidance,
    Progressive,
    StepCache,
    VariancePreserving,
    integrate,
)
from egosim_jax.generation.compiled import CompiledFn
from egosim_jax.generation.denoising import denoise
from egosim_jax.generation.encoding import encode_condition, pack
from egosim_jax.generation.generator import Generator, NonFiniteError
from egosim_jax.models.chunks import Chunks
from egosim_jax.types import InputError, Triplet, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_triplet

DEBUG = configs.get("debug")
CONFIG = dataclasses.replace(DEBUG, video=VideoSpec(frames=5, height=32, width=48), steps=2)


@pytest.fixture(scope="module")
def networks() -> Networks:
    """Random networks whose output head is not zero, as it is before training."""
    made = Networks.random(CONFIG, seed=0)
    head = made.dit.head.linear.kernel
    head[...] = 0.1 * jax.random.normal(jax.random.key(1), head[...].shape)
    return made


@pytest.fixture(scope="module")
def generator(networks: Networks) -> Generator:
    return Generator(CONFIG, networks)


@pytest.fixture(scope="module")
def condition(networks: Networks, triplets: list[Triplet]) -> Condition:
    return CompiledFn(encode_condition, networks)(pack(triplets[:1], CONFIG))


@pytest.fixture(scope="module")
def triplets() -> list[Triplet]:
    return [to_triplet(next(make_sequence(seed, spec=CONFIG.video))) for seed in range(3)]


def test_a_batch_equals_batches_of_one(generator, triplets):
    """Relative L2 of the latents in float32: the sums of a batch run in another order."""
    together = np.asarray(generator.latents(triplets[:2], [3, 1]))
    alone = np.concatenate(
        [generator.latents(triplets[:1], [3]), generator.latents(triplets[1:2], [1])]
    )
    error = np.linalg.norm(together - alone) / np.linalg.norm(alone)
    assert error <= 1e-5


# 8 x 8 latent cells, which the half grid divides.
SQUARE = dataclasses.replace(CONFIG, video=VideoSpec(frames=5, height=64, width=64), steps=4)
PROGRESSIVE = dataclasses.replace(SQUARE, progressive=Progressive(share=0.5))


@pytest.fixture(scope="module")
def squares() -> list[Triplet]:
    return [to_triplet(next(make_sequence(seed, spec=SQUARE.video))) for seed in range(3)]


def test_without_steps_on_half_the_grid_every_bit_is_the_plain_samplers(networks, squares):
    """The plain sampler, written out here."""
    guidance = Guidance(scale=2.0)
    config = dataclasses.replace(SQUARE, guidance=guidance)
    assert config.progressive is None
    generator = Generator(config, networks)
    condition, noise = generator.encode(pack(squares[:1], config)), generator.noise([3])

    def plain(dit, condition, noise):
        channels = config.layout.condition_channels(condition, noise)
        with_text, without = (
            dit.prepare(channels, text, condition.image)
            for text in (condition.text, condition.drop("text").text)
        )
        guided = guidance.guide(
            lambda x, t: dit.denoise(x, t, with_text), lambda x, t: dit.denoise(x, t, without)
        )
        return integrate(guided, noise, process=config.process, solver=config.solver, steps=4)

    expected = np.asarray(CompiledFn(plain, networks.dit)(condition, noise))
    np.testing.assert_array_equal(generator.latents(squares[:1], [3]), expected)


@pytest.mark.parametrize(
    "options",
    [{}, {"guidance": Guidance(scale=2.0), "cache": StepCache(threshold=0.3, first=2)}],
    ids=["plain", "guided, with a cache"],
)
def test_three_clips_with_steps_on_half_the_grid_equal_three_alone(networks, squares, options):
    generator = Generator(dataclasses.replace(PROGRESSIVE, **options), networks)
    together = np.asarray(generator.latents(squares, [3, 1, 2]))
    alone = np.concatenate(
        [generator.latents([clip], [seed]) for clip, seed in zip(squares, [3, 1, 2], strict=True)]
    )
    assert np.linalg.norm(together - alone) / np.linalg.norm(alone) <= 1e-5
    whole = np.asarray(Generator(SQUARE, networks).latents(squares, [3, 1, 2]))
    assert np.linalg.norm(together - whole) / np.linalg.norm(whole) > 1e-3  # they ran


def test_sdedit_starts_on_half_the_grid_from_the_noised_prior(networks, squares):
    """Almost without noise, it returns the prior."""
    config = dataclasses.replace(
        PROGRESSIVE, steps=(1.0, 0.5), strength=1.0, progressive=Progressive(share=0.5)
    )
    generator = Generator(config, networks)
    latents = np.asarray(generator.latents(squares[:1], [3]))
    prior = np.asarray(generator.encode(pack(squares[:1], config)).prior)
    means = prior.reshape(*prior.shape[:2], 4, 2, 4, 2, -1).mean((3, 5))
    np.testing.assert_allclose(latents, means.repeat(2, axis=2).repeat(2, axis=3), atol=0.02)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"video": CONFIG.video}, "4 x 6 cells have no half grid"),
        ({"solver": DPMSolver(stochastic=True)}, "DPMSolver adds noise"),
        ({"process": VariancePreserving(), "solver": DDIM()}, "rectified flow"),
        ({"chunks": Chunks(sizes=(1, 1))}, "chunk by chunk, which supports only progressive None"),
    ],
)
def test_models_without_steps_on_half_the_grid_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        dataclasses.replace(PROGRESSIVE, **changes)


@pytest.mark.parametrize("hidden", ["prior", "mask", "hands", "text"])
def test_a_clip_without_a_condition_does_not_depend_on_it(generator, triplets, hidden):
    """Swapping in another clip's condition changes the video only if it is not hidden."""
    field = {"text": "prompt"}.get(hidden, hidden)
    one, other = triplets[0], triplets[1]
    swapped = dataclasses.replace(one, **{field: getattr(other, field)})
    if hidden == "mask":
        swapped = dataclasses.replace(one, mask=255 - one.mask)
    shown = generator.generate([one, swapped], [7, 7])
    assert not np.array_equal(shown[0].frames, shown[1].frames)
    blind = generator.generate([one, swapped], [7, 7], without=hidden)
    np.testing.assert_array_equal(blind[0].frames, blind[1].frames)


def test_a_seed_gives_its_clip_again_and_another_seed_another(generator, triplets):
    first, second = generator.generate([triplets[0]] * 2, [7, 7])
    third, _ = generator.generate([triplets[0]] * 2, [8, 7])
    np.testing.assert_array_equal(first.frames, second.frames)
    assert not np.array_equal(first.frames, third.frames)
    assert first.frames.shape == (5, 32, 48, 3)
    assert first.fps == CONFIG.video.fps


def test_a_clip_of_a_stochastic_solver_comes_from_its_seed_alone(networks, triplets):
    config = dataclasses.replace(CONFIG, solver=DPMSolver(stochastic=True), steps=3)
    generator = Generator(config, networks)
    together = np.asarray(generator.latents(triplets[:2], [3, 4]))
    apart = np.asarray(generator.latents(triplets[1:3], [4, 5]))[0]
    np.testing.assert_allclose(together[1], apart, rtol=1e-5, atol=1e-5)
    other = dataclasses.replace(config, solver=DPMSolver())
    assert not np.allclose(Generator(other, networks).latents(triplets[1:3], [4, 5])[0], apart)
    assert [name for name, *_ in generator.programs(2)] == ["encode", "noise", "denoise", "decode"]


def test_a_solver_that_does_not_fit_the_process_is_refused():
    with pytest.raises(InputError, match="DDIM"):
        dataclasses.replace(CONFIG, process=VariancePreserving())
    assert dataclasses.replace(CONFIG, process=VariancePreserving(), solver=DDIM())


def test_each_condition_changes_the_latents(networks, condition):
    """Text, image, prior, hands and mask all reach the denoiser."""
    noise = jax.random.normal(jax.random.key(0), (1, *CONFIG.latent_shape, 16))
    run = jax.jit(lambda condition: denoise(networks.dit, condition, noise, CONFIG))
    full = run(condition)
    for name in ("mask", "prior", "hands", "text", "image"):
        other = dataclasses.replace(condition, **{name: 1.5 - getattr(condition, name)})
        assert not np.allclose(run(other), full, atol=1e-4), name


def test_guidance_at_scale_two_extrapolates_from_the_empty_prompt(networks, condition):
    noise = jax.random.normal(jax.random.key(0), (1, *CONFIG.latent_shape, 16))

    def at(scale: float) -> Callable[..., jax.Array]:
        config = dataclasses.replace(CONFIG, steps=1, guidance=Guidance(scale=scale))
        return jax.jit(lambda condition: denoise(networks.dit, condition, noise, config))

    one, two = at(1.0), at(2.0)
    empty = dataclasses.replace(condition, text=jnp.zeros_like(condition.text))
    with_text, without = one(condition), one(empty)
    np.testing.assert_allclose(
        two(condition), without + 2 * (with_text - without), rtol=1e-4, atol=1e-4
    )


def test_latents_that_are_not_finite_name_their_clips(networks, triplets):
    graph, state = nnx.split(networks)
    broken = nnx.merge(graph, jax.tree.map(jnp.copy, state))
    broken.dit.head.linear.bias[...] = jnp.full_like(broken.dit.head.linear.bias[...], jnp.nan)
    with pytest.raises(NonFiniteError, match="tabletop_human_0_0") as found:
        Generator(CONFIG, broken).generate(triplets[:2], [0, 0])
    assert found.value.bad == (0, 1)


def test_weights_of_another_model_are_refused(networks, tmp_path: Path):
    networks.save(tmp_path)
    wider = dataclasses.replace(CONFIG, dit=dataclasses.replace(CONFIG.dit, ffn_dim=100))
    with pytest.raises(InputError, match=r"blocks\.mlp\.up\.kernel: has shape .*; expected .*100"):
        Networks.load(wider, tmp_path)
