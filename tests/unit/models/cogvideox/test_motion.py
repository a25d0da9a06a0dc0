"""Hand poses in the modulation: embedded by frame or for all alike, without effect at first."""

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.models.cogvideox.motion import Motion, MotionDiTConfig, PoseModulation
from egosim_jax.preflight.flops import count
from egosim_jax.types import InputError
from tests.parity.cogvideox_configs.dwm_tiny import CONFIG as TINY

POSES, FRAMES, LATENTS = 6, 9, 3


def config(frames):
    sizes = {f.name: getattr(TINY.dit, f.name) for f in fields(TINY.dit)}
    return MotionDiTConfig(**{**sizes, "in_channels": 33}, frames=frames, pose_dim=POSES)


def draw(*shape):
    return np.random.default_rng(0).standard_normal(shape, np.float32)


@pytest.mark.parametrize(("frames", "rows"), [("frame", LATENTS), ("global", 1)])
def test_poses_are_embedded_by_a_loop_of_convolutions(frames, rows):
    motion, poses = Motion(config(frames), rngs=nnx.Rngs(0)), draw(2, FRAMES, POSES)
    stride = 2 if frames == "frame" else 1

    def linear(layer, x):
        return x @ np.asarray(layer.kernel[...]) + np.asarray(layer.bias[...])

    def silu(x):
        return x / (1 + np.exp(-x))

    def convolve(layer, x):
        inside = range(x.shape[1])
        taps = [
            [x[:, t] if t in inside else 0 * x[:, 0] for t in (at - 1, at, at + 1)]
            for at in range(0, x.shape[1], stride)
        ]
        return np.stack([linear(layer, np.concatenate(row, -1)) for row in taps], axis=1)

    x = linear(motion.down, silu(linear(motion.up, poses)))
    if frames == "frame":
        x = np.concatenate([x[:, :1]] * 3 + [x], axis=1)
    x = convolve(motion.second, silu(convolve(motion.first, x)))
    x = x if frames == "frame" else x.mean(axis=1, keepdims=True)
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + TINY.dit.eps)
    assert x.shape[1] == rows
    np.testing.assert_allclose(motion(jnp.asarray(poses)), x, atol=1e-5)


def test_a_token_is_modulated_by_the_poses_of_its_frame():
    layer = PoseModulation(config("frame"), 2, rngs=nnx.Rngs(0))
    time, motion = draw(1, 16), draw(1, LATENTS, 16)
    frame = jnp.asarray([2, 0, 0, 1])
    before = layer.vectors((time, motion, frame))
    np.testing.assert_array_equal(before, jnp.broadcast_to(before[:, :, :1], before.shape))
    layer.pose.kernel[...] = jnp.asarray(draw(16, 2 * TINY.dit.dim))
    after = layer.vectors((time, motion, frame))
    np.testing.assert_array_equal(after[:, :, 1], after[:, :, 2])
    other = layer.vectors((time, jnp.asarray(motion).at[:, 1].add(1), frame))
    changed = np.abs(other - after).max(axis=(0, 1, 3)) > 1e-3
    assert changed.tolist() == [False, False, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("frames", ["frame", "global"])
def test_poses_do_not_count_until_they_are_trained(frames):
    network = config(frames).build(rngs=nnx.Rngs(0))
    network.out.kernel[...] = jnp.asarray(draw(*network.out.kernel[...].shape))
    graph, params = nnx.split(network)
    condition, text = (jnp.asarray(draw(*shape)) for shape in ((1, LATENTS, 4, 6, 17), (1, 5, 16)))

    @jax.jit
    def predict(params, poses):
        dit = nnx.merge(graph, params)
        context = dit.prepare(condition, text, poses)
        return dit.denoise(jnp.asarray(draw(1, LATENTS, 4, 6, 16)), jnp.asarray([500.0]), context)

    still, moving = jnp.zeros((1, FRAMES, POSES)), jnp.asarray(draw(1, FRAMES, POSES))
    np.testing.assert_array_equal(predict(params, still), predict(params, moving))
    kernel = network.blocks.modulation_a.pose.kernel
    kernel[...] = 0.1 * jnp.asarray(draw(*kernel[...].shape))
    params = nnx.state(network)
    assert np.abs(predict(params, still) - predict(params, moving)).max() > 1e-3


@pytest.mark.parametrize("frames", ["frame", "global"])
def test_the_flops_of_poses_are_those_of_their_layers(frames):
    """By hand and, as the difference from a transformer without them, in the traced programs."""
    sizes = {"latents": (LATENTS, 4, 6), "text": 5, "image": FRAMES}
    plain, posed = replace(TINY.dit, in_channels=33), config(frames)
    dim, depth, wide = plain.dim, plain.layers, plain.time_dim
    layers = FRAMES * POSES * wide + FRAMES * wide * wide
    # 11 padded frames give 6 by stride 2, then 3; without a stride, all 9 stay.
    layers += 3 * wide * wide * (6 + 3 if frames == "frame" else 9 + 9)
    layers += depth * 2 * (LATENTS + 1) * wide * 6 * dim
    added = posed.forward_flops(**sizes).total - plain.forward_flops(**sizes).total
    assert added == 2 * layers

    def counted(chosen, *poses):
        graph, params = nnx.split(nnx.eval_shape(lambda: chosen.build(rngs=nnx.Rngs(0))))

        def predict(params, noisy, t, condition, text, *poses):
            dit = nnx.merge(graph, params)
            return dit.denoise(noisy, t, dit.prepare(condition, text, *poses))

        shapes = (1, LATENTS, 4, 6, 16), (1,), (1, LATENTS, 4, 6, 17), (1, 5, 16), *poses
        given = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
        return count(jax.make_jaxpr(predict)(params, *given))

    assert counted(posed, (1, FRAMES, POSES)) - counted(plain) == added


@pytest.mark.parametrize(("given", "number"), [(None, 0), (jnp.zeros((1, 8, POSES)), 8)])
def test_poses_of_every_pixel_frame_are_needed(given, number):
    network = nnx.eval_shape(lambda: config("frame").build(rngs=nnx.Rngs(0)))
    with pytest.raises(InputError, match=rf"{number} poses .* each of the 9 pixel frames"):
        network.prepare(jnp.zeros((1, LATENTS, 4, 6, 17)), jnp.zeros((1, 5, 16)), given)
