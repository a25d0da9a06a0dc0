"""Sample clips of a training whose denoiser gets zeros as image tokens, like DWM-Wan."""

import dataclasses

import jax
import numpy as np
import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.io.video import read_video
from egosim_jax.sharding import make_mesh
from egosim_jax.train.encode import encode_shards
from egosim_jax.train.monitor import Samples
from egosim_jax.types import MeshConfig, VideoSpec

pytestmark = pytest.mark.slow
SPEC = VideoSpec(frames=5, height=16, width=32)
MODEL = dataclasses.replace(configs.get("debug"), video=SPEC, image=None, zero_image_tokens=3)


def test_sample_clips_are_generated_without_image_tokens_in_the_latents(tmp_path):
    networks = Networks.random(MODEL, seed=0)
    networks.save(tmp_path / "weights")
    with ShardWriter(tmp_path / "clips", kind="frames", spec=SPEC) as writer:
        video = np.random.default_rng(0).integers(0, 256, (5, 16, 32, 3)).astype(np.uint8)
        arrays = {"target": video, "prior": video, "hands": video, "first_frame": video[0]}
        arrays["mask"] = np.zeros((5, 16, 32), np.uint8)
        writer.add(arrays, {"video_id": "a", "prompt": "take the cup", "extra": {}})
    latents = tmp_path / "latents"
    source = ShardReader(tmp_path / "clips")
    encode_shards(MODEL, tmp_path / "weights", source=source, out=latents, stride=1, batch_size=1)
    assert "image" not in ShardReader(latents)[0].arrays
    samples = Samples(model=MODEL, latents=latents, vae=tmp_path / "weights", count=1)
    trained = Networks.build(MODEL, only=MODEL.trained_networks, rngs=nnx.Rngs(0))
    with jax.set_mesh(make_mesh(MeshConfig())):
        samples.write(trained, tmp_path / "samples", 7)
    frames = read_video(tmp_path / "samples" / "step_000007.mp4").frames
    assert frames.shape == (5, 16, 64, 3)
