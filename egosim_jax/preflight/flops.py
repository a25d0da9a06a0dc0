"""FLOPs of a program, counted where it is written, before any compiler has seen it.

Products alone count, a multiplication and an addition as two: those of arrays, convolutions, and
those inside the flash kernels, which a program names and does not spell out. What is computed again
in a backward pass is there to be seen, and counts; what nothing needs does not.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from typing import Any

import jax.numpy as jnp

KERNELS = {
    "dot_product_attention_fwd_wrapper": 2,
    "dot_product_attention_bwd_wrapper": 5,
    "hopper_attention": 2,
}
"""Products in jax's cuDNN kernels, whose backward one computes the scores again, and in ours."""
SPLASH = {"splash_mha_fwd": 2, "splash_mha_dkv": 5}
"""Those in the splash kernels, by how their names begin; the backward one is the fused one."""


def count(jaxpr: Any) -> float:
    """FLOPs of a traced program (`jax.make_jaxpr`, `jax.jit(...).trace`), on all devices."""
    return sum((_of(equation) for equation in _used(getattr(jaxpr, "jaxpr", jaxpr))), 0.0)


def _used(jaxpr: Any) -> Iterator[Any]:
    """The equations that an answer needs, last first; what a policy has kept leaves others behind,
    which no compiler takes over."""
    needed = {id(var) for var in jaxpr.outvars}
    for equation in reversed(jaxpr.eqns):
        if any(id(var) in needed for var in equation.outvars):
            needed.update(id(var) for var in equation.invars)
            yield equation


def _of(equation: Any) -> float:
    name, params = equation.primitive.name, equation.params
    if name == "dot_general":
        ((contracted, _), _) = params["dimension_numbers"]
        left, out = equation.invars[0].aval.shape, equation.outvars[0].aval.shape
        return 2.0 * prod(out) * prod(left[axis] for axis in contracted)
    if name == "conv_general_dilated":
        return _convolution(equation)
    kernel = params.get("name") if name in ("jit", "pjit") else name
    if kernel in KERNELS:
        q, k = (var.aval.shape for var in equation.invars[:2])
        return 2.0 * KERNELS[kernel] * prod(q) * k[1]
    if name == "pallas_call":
        return _splash(equation)
    if name == "scan":
        return params["length"] * count(params["jaxpr"])
    if name == "cond":
        return max(count(branch) for branch in params["branches"])
    copies = params["mesh"].size if name == "shard_map" else 1
    return copies * sum((count(inner) for inner in _inner(params)), 0.0)


def _inner(params: dict[str, Any]) -> list[Any]:
    """The programs that an equation calls."""
    found = (getattr(value, "jaxpr", value) for value in params.values())
    return [value for value in found if hasattr(value, "eqns")]


def _convolution(equation: Any) -> float:
    """Each value of the answer takes a kernel of inputs; each input that is padded in is one, too.

    In the transpose of a strided convolution, most are: those do not count.
    """
    kernel, spec = equation.invars[1].aval.shape, equation.params["dimension_numbers"].rhs_spec
    out = equation.outvars[0].aval.shape
    taps = prod(kernel) / kernel[spec[0]]
    return 2.0 * prod(out) * taps / prod(equation.params["lhs_dilation"])


def _splash(equation: Any) -> float:
    name, avals = str(equation.params["name"]), [var.aval for var in equation.invars]
    (products,) = (n for beginning, n in SPLASH.items() if name.startswith(beginning))
    # Before queries, keys and values come what the kernel knows of its mask, which are integers.
    q, k, *_ = (aval.shape for aval in avals if jnp.issubdtype(aval.dtype, jnp.floating))
    return 2.0 * products * prod(q) * k[-2]
