"""FLOPs counted in jaxprs, versus the closed formula and XLA's own count."""

from functools import partial

import jax
import jax.numpy as jnp
import pytest
from flax import nnx

from egosim_jax.models.attention import attention, keep_attention
from egosim_jax.models.wan.dit import WanDiT, WanDiTConfig
from egosim_jax.preflight.flops import count


def shape(*sizes, dtype=jnp.float32):
    return jax.ShapeDtypeStruct(sizes, dtype)


def counted(function, *args):
    return count(jax.make_jaxpr(function)(*args))


@pytest.mark.usefixtures("cudnn_version")
@pytest.mark.parametrize(
    ("kernel", "tolerance"), [("xla", 1e-9), ("cudnn", 1e-3), ("hopper", 1e-3), ("splash", 3e-3)]
)
def test_a_forward_of_the_14b_is_that_of_the_formula(kernel, tolerance):
    """The kernels pad the image's 257 keys, cuDNN's to 264 and splash to 384, and compute those."""
    config = WanDiTConfig(dtype="bfloat16", attention=kernel)
    graph, params = nnx.split(nnx.eval_shape(lambda: WanDiT(config, rngs=nnx.Rngs(0))))
    given = shape(1, 16, 60, 104, 52), shape(1), shape(1, 512, 4096), shape(1, 257, 1280)
    have = counted(lambda params, *args: nnx.merge(graph, params)(*args), params, *given)
    want = config.forward_flops(latents=(16, 60, 104), text=512, image=257).total
    assert have == pytest.approx(want, rel=tolerance)
    assert want == pytest.approx(1126.17e12, rel=1e-5)


@pytest.mark.parametrize(
    ("function", "args"),
    [
        (lambda a, b: a @ b, (shape(3, 5, 7), shape(7, 11))),
        (partial(jnp.einsum, "bij,bjk->bik"), (shape(4, 3, 5), shape(4, 5, 7))),
        (
            lambda x, k: jax.lax.conv(x, k, (1, 1), "VALID"),
            (shape(2, 3, 16, 16), shape(8, 3, 3, 3)),
        ),
        (
            lambda x, k: jax.lax.conv(x, k, (2, 2), "VALID"),
            (shape(2, 3, 16, 16), shape(8, 3, 2, 2)),
        ),
    ],
)
def test_products_and_convolutions_are_xlas_count(function, args):
    want = jax.jit(function).lower(*args).cost_analysis()["flops"]
    assert counted(function, *args) == pytest.approx(want, rel=1e-6)


def test_loops_count_each_iteration_and_branches_the_longer_one():
    w = shape(8, 8)
    loop = lambda x, w: jax.lax.scan(lambda x, _: (x @ w, None), x, length=5)[0]  # noqa: E731
    either = lambda x, w: jax.lax.cond(x[0, 0] > 0, lambda: x @ w, lambda: x)  # noqa: E731
    assert counted(loop, w, w) == 5 * 2 * 8**3
    assert counted(either, w, w) == 2 * 8**3


def test_a_share_of_a_conditions_runs_takes_the_costliest_branch():
    w = shape(8, 8)

    def loop(x, w):
        step = lambda x, _: (jax.lax.cond(x[0, 0] > 0, lambda: x @ w @ w, lambda: x @ w), None)  # noqa: E731
        return jax.lax.scan(step, x, length=10)[0]

    product, jaxpr = 2 * 8**3, jax.make_jaxpr(loop)(w, w)
    assert count(jaxpr) == 10 * 2 * product
    assert count(jaxpr, taken=0.4) == pytest.approx((4 * 2 + 6) * product)


def test_what_is_computed_again_counts_again():
    w = shape(8, 8)
    step = lambda x, w: jnp.sin(jnp.sin(x @ w) @ w).sum()  # noqa: E731
    plain, again = (
        counted(jax.value_and_grad(f, (0, 1)), w, w) for f in (step, jax.checkpoint(step))
    )
    assert plain == 6 * 2 * 8**3
    assert again > plain


@pytest.mark.usefixtures("cudnn_version")
@pytest.mark.parametrize("kernel", ["cudnn", "splash"])
def test_a_flash_kernel_computes_the_scores_twice(kernel):
    q = shape(2, 256, 4, 128, dtype=jnp.bfloat16)
    value = lambda *x: attention(*x, kernel=kernel).astype(jnp.float32).sum()  # noqa: E731
    product = 2 * 2 * 4 * 256 * 256 * 128
    assert counted(value, q, q, q) == 2 * product
    # Besides the kernel there is a sum over g · out, which splash writes as a product.
    assert counted(jax.grad(value, (0, 1, 2)), q, q, q) == pytest.approx(7 * product, rel=1e-3)


@pytest.mark.usefixtures("cudnn_version")
@pytest.mark.parametrize("kernel", ["cudnn", "hopper", "splash"])
@pytest.mark.parametrize(("policy", "products"), [(None, 9), (keep_attention, 7)])
def test_what_a_policy_keeps_is_not_computed_again(kernel, policy, products):
    q = shape(2, 1024, 4, 128, dtype=jnp.bfloat16)

    @partial(jax.checkpoint, policy=policy)
    def value(*x):
        return (attention(*x, kernel=kernel).astype(jnp.float32) ** 2).sum()

    product = 2 * 2 * 4 * 1024 * 1024 * 128
    found = counted(jax.value_and_grad(value, (0, 1, 2)), q, q, q)
    assert found == pytest.approx(products * product, rel=1e-3)
