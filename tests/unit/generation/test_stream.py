"""Clips that are shown while they are decoded."""

import dataclasses

import jax
import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.generation.generator import Generator
from egosim_jax.generation.stream import Streamer
from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import tabletop_start
from egosim_jax.sharding import make_mesh
from egosim_jax.types import MeshConfig, VideoSpec

VIDEO = VideoSpec(frames=9, height=32, width=48)


@pytest.mark.slow
def test_a_streamed_clip_is_the_generated_one_in_groups_of_its_latent_frames():
    config = dataclasses.replace(configs.get("debug"), video=VIDEO, steps=1)
    networks = Networks.random(config, seed=0)
    head = networks.dit.head.linear.kernel
    head[...] = 0.1 * jax.random.normal(jax.random.key(1), head[...].shape)
    mesh = make_mesh(MeshConfig(data=1, fsdp=1), jax.devices()[:1])
    generator = Generator(config, networks, mesh)
    streamer = Streamer(generator)
    streamer.compile()
    spec = ActionSpec()
    start = tabletop_start(0, spec, VIDEO)
    rows = np.repeat(spec.rest[None], VIDEO.frames, axis=0)
    action, _ = spec.to_action(rows, camera=start.camera, prompt="rest")
    view = generator.renderer.render(start.state, action.cameras, point_px=2)
    shown = list(streamer.stream(view, action, start.first_frame, 3))
    assert [len(frames) for frames in shown] == [1, 4, 4]
    clip = streamer(view, action, start.first_frame, 3)
    np.testing.assert_array_equal(np.concatenate(shown), clip)
    whole = generator(view, action, start.first_frame, 3)
    assert np.abs(clip.astype(int) - whole).max() <= 1  # sums of another program
    assert streamer.fingerprint() == generator.fingerprint()
    triplet = streamer.condition(view, action, start.first_frame)
    both = list(streamer.groups([triplet, triplet], [3, 4]))
    assert [frames.shape[:2] for frames in both] == [(2, 1), (2, 4), (2, 4)]
    assert np.abs(np.concatenate(both, axis=1)[0].astype(int) - clip).max() <= 1
