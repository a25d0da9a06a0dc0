"""Clips that are shown while they are made: chunk by chunk, and frames as they are decoded."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.conditioning.layout import ChannelLayout
from egosim_jax.configs.model import Networks
from egosim_jax.generation.encoding import pack, pack_videos
from egosim_jax.generation.generator import Generator
from egosim_jax.generation.stream import ClipStream, NonFiniteError, split_triplet
from egosim_jax.models.chunks import Chunks
from egosim_jax.models.wan.dit import WanDiTConfig
from egosim_jax.sharding import make_mesh
from egosim_jax.testing import random_triplet
from egosim_jax.types import InputError, MeshConfig, VideoSpec

DEBUG = configs.get("debug")
WHOLE = replace(
    DEBUG,
    video=VideoSpec(frames=9, height=32, width=32),
    dit=WanDiTConfig(dim=48, ffn_dim=32, heads=4, layers=1, text_dim=64, image_dim=32),
    steps=1,
)
STUDENT = replace(WHOLE, chunks=Chunks(sizes=(2, 1)))
"""Chunks of 5 and 4 frames."""


@pytest.fixture(scope="module")
def networks():
    made = Networks.random(STUDENT, seed=0)
    head = made.dit.head.linear.kernel
    head[...] = 0.1 * jax.random.normal(jax.random.key(1), head[...].shape)
    return made


@pytest.fixture(scope="module")
def student(networks):
    return Generator(STUDENT, networks)


@pytest.fixture(scope="module")
def clips():
    return [random_triplet(STUDENT.video, seed) for seed in range(2)]


@pytest.fixture(scope="module")
def groups(student, clips):
    """Groups of frames of the first clip."""
    return list(student.groups(clips[:1], [3]))


def test_streamed_frames_are_those_of_decoding_at_once(student, clips, groups):
    assert [group.shape for group in groups] == [(1, n, 32, 32, 3) for n in (1, 4, 4)]
    streamed = np.concatenate(groups, axis=1)
    np.testing.assert_array_equal(student.decode(student.latents(clips[:1], [3])), streamed)
    np.testing.assert_array_equal(student.generate(clips[:1], [3])[0].frames, streamed[0])


def test_a_chunk_depends_on_no_later_condition(student, clips, groups):
    """The second chunk gets the conditions of another clip, after the first was seen."""
    own, other = (split_triplet(clip, student.chunk_frames) for clip in clips)
    stream = ClipStream(student, [3])
    stream.put([own[0]])
    first = np.concatenate(list(stream.take()), axis=1)
    np.testing.assert_array_equal(first, np.concatenate(groups[:2], axis=1))
    stream.put([other[1]])
    (second,) = stream.take()
    assert not np.array_equal(second, groups[2])
    with pytest.raises(InputError, match="All 2 chunks of this clip of debug are made"):
        stream.put([other[1]])


def test_conditions_encoded_by_chunk_are_those_encoded_at_once(student, clips):
    whole = student.encode(pack(clips[:1], STUDENT))
    caches, found = None, {"prior": [], "hands": [], "mask": []}
    for number, part in enumerate(split_triplet(clips[0], student.chunk_frames)):
        videos = pack_videos([part], STUDENT, continued=number > 0)
        found["mask"].append(videos.pop("mask"))
        latents, caches = student.codec.encode(videos, caches)
        for name, value in latents.items():
            found[name].append(value)
    for name, parts in found.items():
        want = getattr(whole, name)
        np.testing.assert_allclose(np.concatenate(parts, axis=1), want, rtol=0, atol=2e-6)


@pytest.mark.parametrize("packing", ["space", "time", "single"])
def test_masks_are_packed_by_chunk_as_at_once(packing):
    parts = (("noisy", 16), ("mask", 1 if packing == "single" else 4))
    layout = ChannelLayout(parts=parts, mask_packing=packing)
    dit = replace(DEBUG.dit, in_channels=layout.channels)
    config = replace(DEBUG, layout=layout, dit=dit, video=VideoSpec(frames=17, height=16, width=32))
    clip = random_triplet(config.video, 0)
    chunks = split_triplet(clip, (5, 8, 4))
    packed = [
        pack_videos([part], config, continued=number > 0)["mask"]
        for number, part in enumerate(chunks)
    ]
    np.testing.assert_array_equal(
        np.concatenate(packed, axis=1), pack_videos([clip], config)["mask"]
    )


def test_the_programs_of_a_student_are_those_it_runs(student, groups):
    names = [name for name, *_ in student.programs(1, streamed=True)]
    assert names == [
        "encode", "encode chunk 1", "encode chunk 2", "noise", "share", "chunk 1", "chunk 2",
        "decode 1", "decode 2",
    ]  # fmt: skip
    for name, program, given in student.programs(1, streamed=True):
        compiled = list(program._compiled)
        program.shapes(*given)
        assert list(program._compiled) == compiled, f"{name} was not run for these shapes"
    assert [name for name, *_ in student.programs(1)][-1] == "decode"


def test_latents_that_are_not_finite_end_the_stream(student, clips, monkeypatch):
    broken = lambda *_: (jnp.full((1, n, 4, 4, 16), jnp.nan) for n in (2, 1))  # noqa: E731
    monkeypatch.setattr(student.denoiser, "latents", broken)
    with pytest.raises(NonFiniteError, match=clips[0].video_id):
        list(student.groups(clips[:1], [3]))


@pytest.mark.slow
def test_a_model_of_whole_clips_streams_one_chunk(networks, clips):
    mesh = make_mesh(MeshConfig(data=1, fsdp=1), jax.devices()[:1])
    generator = Generator(WHOLE, networks, mesh)
    assert generator.chunk_frames == (9,)
    generator.compile(1, streamed=True)
    groups = list(generator.groups(clips[:1], [3]))
    assert [frames.shape[:2] for frames in groups] == [(1, 1), (1, 4), (1, 4)]
    whole = generator.generate(clips[:1], [3])[0].frames
    difference = np.concatenate(groups, axis=1)[0].astype(int) - whole
    assert np.abs(difference).max() <= 1  # sums of another program
    both = list(generator.groups(clips, [3, 4]))
    assert [frames.shape[:2] for frames in both] == [(2, 1), (2, 4), (2, 4)]
