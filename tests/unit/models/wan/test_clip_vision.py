"""The CLIP image encoder by itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.io.weights import fill, flat_shapes
from egosim_jax.models.wan.clip_vision import CLIPVision, CLIPVisionConfig, PatchEmbed
from egosim_jax.types import InputError

SIZES = dict(image_size=42, patch=14, dim=32, layers=3, heads=4, ffn_dim=48)


def images(count=2):
    return jax.random.normal(jax.random.key(0), (count, 42, 42, 3))


def test_a_patch_is_the_weighted_sum_of_its_pixels():
    embed = PatchEmbed(CLIPVisionConfig(**SIZES), rngs=nnx.Rngs(0))
    kernel, pixels = np.asarray(embed.kernel[...], np.float64), images(1)
    # the patch in row 1, column 2 of a 3 x 3 grid is token 5
    want = (np.asarray(pixels)[0, 14:28, 28:42, :, None] * kernel).sum(axis=(0, 1, 2))
    # float32 sums of 588 terms
    np.testing.assert_allclose(embed(pixels)[0, 5], want, rtol=1e-4, atol=1e-5)


def test_only_the_blocks_before_the_skipped_ones_exist():
    model = nnx.eval_shape(
        lambda: CLIPVision(CLIPVisionConfig(**SIZES, skip_last=2), rngs=nnx.Rngs(0))
    )
    assert {leaf.shape[0] for _, leaf in nnx.to_flat_state(nnx.state(model.blocks))} == {1}


def test_bfloat16_stays_close_to_float32():
    def encode(dtype):
        config = CLIPVisionConfig(**SIZES, dtype=dtype)
        model = nnx.eval_shape(lambda: CLIPVision(config, rngs=nnx.Rngs(0)))
        draw = np.random.default_rng(0).normal
        fill(
            model,
            {path: draw(size=shape, scale=0.2) for path, shape in flat_shapes(model).items()},
            dtype="float32",
        )
        return jax.jit(model)(images())

    want, have = encode("float32"), encode("bfloat16")
    assert have.dtype == jnp.bfloat16
    # 8 bits of mantissa, rounded a few times a block
    assert np.linalg.norm(have.astype(np.float32) - want) <= 0.03 * np.linalg.norm(want)


def test_every_weight_names_one_logical_axis_a_dimension():
    model = nnx.eval_shape(lambda: CLIPVision(CLIPVisionConfig(**SIZES), rngs=nnx.Rngs(0)))
    for path, leaf in nnx.to_flat_state(nnx.state(model)):
        axes = leaf.get_metadata()["axes"]
        assert len(axes) == len(leaf.shape), path
        assert (axes[0] == "layers") == (path[0] == "blocks"), path


@pytest.mark.parametrize(
    "sizes", [{"image_size": 50}, {"image_size": 7}, {"heads": 5}, {"skip_last": 3}]
)
def test_sizes_that_do_not_fit_are_refused(sizes):
    with pytest.raises(InputError):
        CLIPVisionConfig(**(SIZES | sizes))
