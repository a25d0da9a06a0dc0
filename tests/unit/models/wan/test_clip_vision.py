"""The CLIP image encoder by itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.io.weights import fill, flat_shapes
from egosim_jax.models.wan.clip_vision import CLIPVision, CLIPVisionConfig
from egosim_jax.types import InputError

SIZES = dict(image_size=42, patch=14, dim=32, layers=3, heads=4, ffn_dim=48)


def images(count=2):
    return jax.random.normal(jax.random.key(0), (count, 42, 42, 3))


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


@pytest.mark.parametrize(
    "sizes", [{"image_size": 50}, {"image_size": 7}, {"heads": 5}, {"skip_last": 3}]
)
def test_sizes_that_do_not_fit_are_refused(sizes):
    with pytest.raises(InputError):
        CLIPVisionConfig(**(SIZES | sizes))
