"""Generation by a causal student: its chunks, its weights, and what it refuses."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.conditioning.condition import Condition
from egosim_jax.configs.model import Networks
from egosim_jax.diffusion.guidance import Guidance
from egosim_jax.generation.causal import ChunkDenoiser
from egosim_jax.generation.denoising import denoise
from egosim_jax.models.chunks import Chunks
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.types import InputError, VideoSpec
from tests.toy_family.configs.toy import CONFIG as TOY

DEBUG = configs.get("debug")
STUDENT = replace(
    DEBUG,
    video=VideoSpec(frames=9, height=32, width=32),
    dit=WanDiTConfig(dim=48, ffn_dim=32, heads=4, layers=2, text_dim=64, image_dim=32),
    chunks=Chunks(sizes=(1, 2), first_steps=2),
    steps=1,
)
"""3 latent frames of 2 x 2 tokens."""


def condition(batch):
    """Return the conditions of clips."""
    rng = np.random.default_rng(0)
    draw = lambda *shape: jnp.asarray(rng.standard_normal((batch, *shape)), jnp.float32)  # noqa: E731
    video = (3, 4, 4)
    return Condition(
        mask=jnp.float32(draw(*video, 4) > 0), prior=draw(*video, 16),
        hands=draw(*video, 16), text=draw(5, 64), image=draw(3, 32),
    )  # fmt: skip


def noise(batch):
    drawn = np.random.default_rng(1).standard_normal((batch, 3, 4, 4, 16))
    return jnp.asarray(drawn, jnp.float32)


def given(batch):
    """Return the inputs of a student's chunks."""
    clip = condition(batch)
    channels = STUDENT.layout.condition_channels(clip, noise(batch))
    return clip.text, clip.image, [channels[:, :1], channels[:, 1:]], noise(batch)


def network():
    """Return a denoiser with random weights."""
    dit = nnx.jit(lambda: STUDENT.dit.build(rngs=nnx.Rngs(0)))()
    kernel = dit.head.linear.kernel
    kernel[...] = 0.1 * jax.random.normal(jax.random.key(1), kernel[...].shape)  # not zero
    return dit


@pytest.fixture(scope="module")
def dit():
    return network()


@pytest.fixture(scope="module")
def student(dit):
    return ChunkDenoiser(STUDENT, dit)


def at_once(dit, config):
    graph, params = nnx.split(dit)
    program = jax.jit(lambda params, *args: denoise(nnx.merge(graph, params), *args, config))
    return program(params, condition(2), noise(2))


def assert_close(have, want):
    assert np.linalg.norm(have - want) <= 1e-5 * np.linalg.norm(want)


def test_chunks_of_several_programs_are_those_of_one(dit, student):
    chunks = list(student.latents(*given(2)))
    assert [chunk.shape[1] for chunk in chunks] == [1, 2]
    assert_close(np.concatenate(chunks, axis=1), at_once(dit, STUDENT))


def test_one_chunk_of_the_whole_clip_is_the_bidirectional_model(dit):
    config = replace(STUDENT, chunks=None, steps=2)
    one = replace(config, chunks=Chunks(sizes=(3,), refresh=True))
    assert_close(at_once(dit, one), at_once(dit, config))


def test_later_chunks_see_the_clean_chunk_after_a_refresh(dit):
    """With one step, what the later chunks see without it is pure noise."""
    refreshed = replace(STUDENT, chunks=replace(STUDENT.chunks, refresh=True))
    have, want = at_once(dit, refreshed), at_once(dit, STUDENT)
    assert_close(have[:, :1], want[:, :1])
    assert np.abs(have[:, 1:] - want[:, 1:]).max() > 1e-4


def test_conditions_of_another_number_or_length_are_refused(student):
    text, image, (first, second), start = given(2)
    for conditions, message in (
        ([first], "has 2 chunks of 1 . 2 latent frames, but there are only 1"),
        ([second], "Chunk 1 of debug has 1 latent frames, but its condition has 2"),
        ([first, second, first], "there are at least 3 conditions"),
    ):
        with pytest.raises(InputError, match=message):
            list(student.latents(text, image, conditions, start))


@pytest.mark.parametrize(
    ("config", "change", "message"),
    [
        (DEBUG, {"chunks": Chunks(sizes=(2, 2))}, r"Chunks of 2 \+ 2 latent .* clips have 3"),
        (STUDENT, {"guidance": Guidance(scale=3.0)}, r"only guidance.scale 1.0, not 3.0"),
        (STUDENT, {"strength": 0.5}, "only strength None, not 0.5"),
        (TOY, {"chunks": Chunks(sizes=(4,))}, "ToyDenoiserConfig is not causal"),
    ],
    ids=["sizes", "guidance", "strength", "toy"],
)
def test_what_no_student_can_be_is_refused(config, change, message):
    with pytest.raises(InputError, match=message):
        replace(config, **change)


def test_weights_of_another_kind_are_refused(tmp_path):
    """The networks have the same shapes, so the file must say which they are."""
    layer = nnx.Linear(2, 2, rngs=nnx.Rngs(0))
    whole, other = replace(STUDENT, chunks=None), replace(STUDENT, chunks=Chunks(sizes=(2, 1)))
    for has, needs, message in (
        (None, STUDENT, r"is a denoiser of whole clips; .* needs a causal student .*'1 \+ 2'"),
        (STUDENT.chunks, whole, r"student with chunks of '1 \+ 2' .* needs a denoiser of whole"),
        (STUDENT.chunks, other, r"'1 \+ 2' latent frames; .* needs .* '2 \+ 1'"),
    ):
        Networks(dit=layer, chunks=has).save(tmp_path)
        load = partial(Networks.load, needs, tmp_path, only=["dit"])
        with pytest.raises(InputError, match=message):
            load()
    with pytest.raises(InputError, match="do not match"):  # these are no weights of a denoiser
        Networks.load(STUDENT, tmp_path, only=["dit"])
