"""Clips that are shown while they are decoded."""

import dataclasses

import jax
import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.env.actions import ActionSpec
from egosim_jax.env.backends import tabletop_start
from egosim_jax.env.streaming import Streamer
from egosim_jax.generator import Generator
from egosim_jax.networks import Networks
from egosim_jax.types import VideoSpec

VIDEO = VideoSpec(frames=9, height=32, width=48)


@pytest.mark.slow
def test_a_streamed_clip_is_the_generated_one_in_groups_of_its_latent_frames():
    config = dataclasses.replace(configs.get("debug"), video=VIDEO, steps=1)
    networks = Networks.random(config, seed=0)
    head = networks.dit.head.linear.kernel
    head[...] = 0.1 * jax.random.normal(jax.random.key(1), head[...].shape)
    generator = Generator(config, networks)
    streamer, shown = Streamer(generator), []
    streamer.compile()
    streamer.show = shown.append
    spec = ActionSpec()
    start = tabletop_start(0, spec, VIDEO)
    rows = np.repeat(spec.rest[None], VIDEO.frames, axis=0)
    action, _ = spec.to_action(rows, camera=start.camera, prompt="rest", hide=True)
    view = generator.renderer.render(start.state, action.cameras, point_px=2)
    clip = streamer(view, action, start.first_frame, 3)
    assert [len(frames) for frames in shown] == [1, 4, 4]
    np.testing.assert_array_equal(np.concatenate(shown), clip)
    whole = generator(view, action, start.first_frame, 3)
    assert np.abs(clip.astype(int) - whole).max() <= 1  # sums of another program
    assert streamer.fingerprint() == generator.fingerprint()
