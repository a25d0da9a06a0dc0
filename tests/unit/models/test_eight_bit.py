"""Linear layers with weights in 8 bits, versus products in NumPy."""

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
from flax import nnx

from egosim_jax import configs
from egosim_jax.io.weights import flat_shapes
from egosim_jax.models import eight_bit
from egosim_jax.models.eight_bit import DTYPES, EightBitLinear, channel_scales, quantized
from egosim_jax.models.layers import Linear

WIDE, OUT = 48, 20


def make_kernel(seed=0):
    """A kernel whose channels differ in magnitude by a factor of a million."""
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(WIDE, OUT)) * 10.0 ** rng.uniform(-4, 2, OUT)).astype(np.float32)


def make_layer(kind, *, activations=False, dtype="float32"):
    """An 8-bit layer, and its exact weights: kernel and bias in float64."""
    linear = Linear(WIDE, OUT, axes=("embed", "mlp"), dtype=dtype, rngs=nnx.Rngs(0))
    kernel, bias = make_kernel(), np.linspace(-1, 1, OUT, dtype=np.float32)
    linear.bias[...] = jnp.asarray(bias)
    layer = EightBitLinear(linear, DTYPES[kind], activations=activations)
    scales = channel_scales(kernel, DTYPES[kind])
    values = quantized(kernel, scales, DTYPES[kind])
    layer.kernel.set_value(jnp.asarray(values))
    layer.scale.set_value(jnp.asarray(scales))
    return layer, values.astype(np.float64) * scales.astype(np.float64), bias.astype(np.float64)


@pytest.mark.parametrize("dtype", ["float32", "float16", "bfloat16"])
def test_int8_is_off_by_at_most_half_a_step_of_its_channel(dtype):
    kernel = make_kernel().astype(dtype)
    scales = channel_scales(kernel, DTYPES["int8"])
    values = quantized(kernel, scales, DTYPES["int8"])
    exact = kernel.astype(np.float64)
    error = np.abs(values.astype(np.float64) * scales - exact)
    assert (error <= 0.5001 * np.abs(exact).max(axis=0) / 127).all()
    assert np.abs(values.astype(int)).max(axis=0).tolist() == [127] * OUT


def test_float8_is_off_by_at_most_half_of_its_last_bit():
    """Three bits of mantissa; below 2^-6 of the scale the steps are 2^-9."""
    kernel = make_kernel()
    scales = channel_scales(kernel, DTYPES["float8"])
    values = quantized(kernel, scales, DTYPES["float8"]).astype(np.float64)
    error = np.abs(values * scales - kernel)
    assert (error <= np.maximum(np.abs(kernel) / 16, scales / 1024) * 1.0001).all()
    assert np.abs(values).max(axis=0).tolist() == [448] * OUT


@pytest.mark.parametrize("kind", DTYPES)
def test_a_channel_of_zeros_has_the_scale_1(kind):
    kernel = make_kernel()
    kernel[:, 3] = 0
    scales = channel_scales(kernel, DTYPES[kind])
    assert scales[3] == 1
    assert not quantized(kernel, scales, DTYPES[kind]).astype(float)[:, 3].any()


@pytest.mark.parametrize("kind", DTYPES)
def test_a_layer_computes_the_product_of_its_dequantized_weights(kind):
    layer, kernel, bias = make_layer(kind)
    x = np.random.default_rng(1).normal(size=(2, 7, WIDE)).astype(np.float32)
    want = x.astype(np.float64) @ kernel + bias
    np.testing.assert_allclose(layer(jnp.asarray(x)), want, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", DTYPES)
def test_bfloat16_factors_hold_every_8_bit_value(kind):
    layer, kernel, bias = make_layer(kind, dtype="bfloat16")
    x = np.random.default_rng(1).normal(size=(5, WIDE)).astype(ml_dtypes.bfloat16)
    got = layer(jnp.asarray(x))
    assert got.dtype == jnp.bfloat16
    want = (x.astype(np.float64) @ kernel).astype(ml_dtypes.bfloat16).astype(np.float64) + bias
    # Two roundings to bfloat16, of product and sum: 2^-8 of each at most.
    bound = 2**-7 * (np.abs(want) + np.abs(bias)) + 1e-6
    assert (np.abs(np.asarray(got, np.float64) - want) <= bound).all()


@pytest.mark.parametrize("kind", DTYPES)
def test_activations_are_rounded_by_the_token(kind):
    layer, kernel, bias = make_layer(kind, activations=True)
    x = np.random.default_rng(1).normal(size=(3, 4, WIDE)).astype(np.float32)
    x *= 10.0 ** np.arange(-6, 6).reshape(3, 4, 1)
    x[0, 0] = 0
    x[0, 1] = 0
    x[0, 1, 3] = 1e-40  # whose scale would be 0
    largest = np.abs(x).max(-1, keepdims=True)
    steps = largest / np.float32(eight_bit.maximum(DTYPES[kind]))
    steps = np.maximum(steps, np.finfo(np.float32).tiny)
    scaled = x / steps
    rounded = (np.rint(scaled) if kind == "int8" else scaled).astype(DTYPES[kind])
    want = (rounded.astype(np.float64) * steps) @ kernel + bias
    got = np.asarray(layer(jnp.asarray(x)), np.float64)
    assert (np.abs(got - want) <= 1e-5 * largest * np.abs(kernel).sum(axis=0) + 1e-5).all()
    np.testing.assert_allclose(got[0, :2], [bias, bias], rtol=1e-6)


@pytest.mark.parametrize("kind", DTYPES)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_activations_that_are_not_finite_do_not_become_numbers(kind, bad):
    layer, _, _ = make_layer(kind, activations=True)
    x = np.ones((2, WIDE), np.float32)
    x[0, 5] = bad
    finite = np.isfinite(layer(jnp.asarray(x)))
    assert not finite[0].any()
    assert finite[1].all()


def test_only_attention_and_mlp_of_blocks_are_in_8_bits():
    config = configs.get("debug").dit
    dit = nnx.eval_shape(lambda: config.build(rngs=nnx.Rngs(0)))
    layers = eight_bit.layers_of(flat_shapes(dit))
    assert len(layers) == 4 + 4 + 2 + 2  # self- and cross-attention, its image, MLP
    eight_bit.adapt(dit, dict.fromkeys(layers, DTYPES["int8"]))
    shapes = flat_shapes(dit)
    narrow = [path for path, leaf in nnx.to_flat_state(nnx.state(dit)) if leaf.dtype == np.int8]
    assert {".".join(map(str, path[:-1])) for path in narrow} == set(layers)
    blocks, wide, out = shapes["blocks.mlp.up.kernel"]
    assert (wide, out) == (config.dim, config.ffn_dim)
    assert shapes["blocks.mlp.up.scale"] == (blocks, out)
    axes = dit.blocks.mlp.down.scale.get_metadata()["axes"]
    assert axes == ("layers", "embed")  # split over devices like the kernel's output axis


def test_the_product_of_8_bit_factors_is_one_of_8_bits():
    for kind, dtype in DTYPES.items():
        layer, _, _ = make_layer(kind, activations=True)
        text = str(jax.make_jaxpr(layer)(jnp.ones((2, WIDE))))
        assert f"{'i8' if dtype == np.int8 else 'f8_e4m3fn'}[2,{WIDE}]" in text
