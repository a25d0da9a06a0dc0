"""Refining a VAE: loss, trained weights, command."""

import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.data.shards import ShardWriter
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.runtime.command import ExitCode
from egosim_jax.train.__main__ import main
from egosim_jax.train.config import TrainConfig
from egosim_jax.train.refine_vae import RefineVAE
from egosim_jax.train.tasks.autoencoding import Autoencoding
from egosim_jax.train.tasks.refining import MOVING, Refining, motion_weights
from egosim_jax.types import InputError, VideoSpec

VAE = configs.get("debug").vae
VIDEO = VideoSpec(frames=5, height=32, width=40)
SIZES = {"vae": VAE, "video": VIDEO, "crop": (32, 32)}
RECIPE = RefineVAE(
    config="debug",
    vae=TrainConfig(steps=3, batch_size=1, log_every=1, save_every=2, validate_every=2),
    crop=(32, 32),
    perceptual_frames=1,
)


def test_the_decoder_alone_is_trained_on_request():
    task = Refining(**SIZES, part="decoder")
    networks = nnx.eval_shape(lambda: task.networks(nnx.Rngs(0)))
    _, trained, others = nnx.split(networks, task.trained, ...)
    assert {path[:2] for path, _ in nnx.to_flat_state(trained)} == {
        ("vae", "decoder"),
        ("vae", "from_latents"),
    }
    assert {path[:2] for path, _ in nnx.to_flat_state(others)} == {
        ("vae", "encoder"),
        ("vae", "to_moments"),
    }


@pytest.mark.slow
def test_lpips_is_added_to_the_loss_of_autoencoding():
    vae = nnx.jit(lambda: VAE.build(rngs=nnx.Rngs(0)))()
    crop = np.random.default_rng(0).integers(0, 256, (1, 5, 32, 32, 3), np.uint8)
    task = Refining(**SIZES, perceptual_weight=0.25, perceptual_frames=5)

    @jax.jit
    def losses(vae, batch):
        keys = task.keys(jax.random.key(0), 1)
        plain, _ = Autoencoding(**SIZES).loss(vae, batch, keys)
        return plain, *task.loss(Networks(vae=vae), batch, keys)

    plain, loss, metrics = losses(vae, {"video": jnp.asarray(crop)})
    assert 0.1 < metrics["lpips"] < 2
    np.testing.assert_allclose(loss, plain + 0.25 * metrics["lpips"], rtol=1e-6)


def test_moving_places_weigh_more_and_a_still_video_weighs_alike():
    still = jnp.zeros((1, 2, 4, 4, 3))
    np.testing.assert_array_equal(motion_weights(still, 4.0), 1.0)
    half = np.sqrt(2 * MOVING)  # 0, then this: a variance of MOVING / 2
    moving = still.at[:, 1, 0].set(1.0).at[:, 1, 1].set(half)
    expected = np.array([5.0, 3.0, 1.0, 1.0]) / 2.5
    np.testing.assert_allclose(motion_weights(moving, 4.0)[0, 0, :, 0, 0], expected, rtol=1e-6)


def test_without_a_weight_of_motion_the_squared_error_is_the_plain_one():
    draws = np.random.default_rng(0).uniform(-1, 1, (2, 1, 5, 32, 32, 3)).astype(np.float32)
    decoded, video = jnp.asarray(draws)
    plain = Autoencoding(**SIZES).squared_error(decoded, video)
    assert Refining(**SIZES).squared_error(decoded, video) == plain
    weighted = Refining(**SIZES, motion_weight=4.0).squared_error(decoded, video)
    by_hand = np.mean(motion_weights(video, 4.0) * np.square(draws[0] - draws[1]))
    np.testing.assert_allclose(weighted, by_hand, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"crop": (32, 24)}, "too small for LPIPS"),
        ({"perceptual_frames": 6}, "must compare 1 to 5 frames"),
    ],
)
def test_what_lpips_cannot_compare_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        Refining(**{**SIZES, **change})


def frames(folder, model):
    rng, video = np.random.default_rng(0), model.video
    size = (video.frames, video.height, video.width)
    for split in ("train", "test"):
        spec, grid = model.video, model.grid
        with ShardWriter(folder / split, kind="frames", spec=spec, grid=grid) as writer:
            arrays = {
                name: rng.integers(0, 256, (*size, 3), np.uint8)
                for name in ("target", "prior", "hands")
            }
            arrays["mask"] = np.zeros(size, np.uint8)
            arrays["first_frame"] = arrays["prior"][0]
            writer.add(arrays, {"video_id": split, "prompt": ""})
    return folder


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["tabletop_vae", "--weights-dtype", "fp16"], "float16"),
        (["tabletop", "--weights-dtype", "fp16"], "float16"),
        (["tabletop", "--stride", "0"], "--stride must be at least 1, not 0"),
    ],
)
def test_what_would_fail_after_the_training_is_refused_before(command, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        sys.exit(main([*command, "--out", str(tmp_path / "out")]))
    assert ended.value.code == ExitCode.USAGE
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_refined_decoder_reads_the_latents_of_before(tmp_path):
    model = configs.get("debug")
    start = tmp_path / "weights"
    Networks.random(model, seed=0).save(start)
    recipe = replace(
        RECIPE,
        frames=frames(tmp_path / "frames", model),
        weights=start,
        out=tmp_path / "out",
        part="decoder",
        weights_dtype="float32",
    )
    assert recipe.train() == 0
    before, after = (
        {name: tensor.array() for name, tensor in read_safetensors(folder).items()}
        for folder in (start / "vae.safetensors", tmp_path / "out" / "weights" / "vae.safetensors")
    )
    changed = {name for name in before if not np.array_equal(before[name], after[name])}
    assert {name.split(".")[0] for name in changed} == {"decoder", "from_latents"}
    assert (tmp_path / "out" / "weights" / "dit.safetensors").exists()
    assert recipe.train() == 0  # at its end: writes the same weights again
