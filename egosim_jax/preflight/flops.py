"""FLOPs of a traced program, counted in its jaxpr.

Counts matrix products and convolutions, with two FLOPs for a multiplication and an addition. Flash
attention kernels, which a jaxpr only names, count by the products inside. Rematerialization in a
backward pass counts; equations with unused results do not. Of the branches of a condition, the
costliest counts, or a share of it where it runs at some of the steps only (`StepCache`).
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
"""Products in jax's cuDNN kernels and in ours; the backward pass recomputes the scores."""
SPLASH = {"splash_mha_fwd": 2, "splash_mha_dkv": 5}
"""Products in the splash kernels, by the beginning of the name; the backward pass is fused."""


def count(jaxpr: Any, *, taken: float = 1.0) -> float:
    """Return the FLOPs of a traced program (`jax.make_jaxpr`, `jax.jit(...).trace`).

    `taken` is the share of the runs of a condition that take its costliest branch; the others take
    the cheapest one.
    """
    equations = _used(getattr(jaxpr, "jaxpr", jaxpr))
    return sum((_of(equation, taken) for equation in equations), 0.0)


def _used(jaxpr: Any) -> Iterator[Any]:
    """Yield the equations that the outputs need, last first.

    A checkpoint policy leaves unused equations behind, which compilers remove.
    """
    needed = {id(var) for var in jaxpr.outvars}
    for equation in reversed(jaxpr.eqns):
        if any(id(var) in needed for var in equation.outvars):
            needed.update(id(var) for var in equation.invars)
            yield equation


def _of(equation: Any, taken: float) -> float:
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
        return params["length"] * count(params["jaxpr"], taken=taken)
    if name == "cond":
        costs = [count(branch, taken=taken) for branch in params["branches"]]
        return taken * max(costs) + (1 - taken) * min(costs)
    copies = params["mesh"].size if name == "shard_map" else 1
    return copies * sum((count(inner, taken=taken) for inner in _inner(params)), 0.0)


def _inner(params: dict[str, Any]) -> list[Any]:
    """Return the jaxprs that an equation calls."""
    found = (getattr(value, "jaxpr", value) for value in params.values())
    return [value for value in found if hasattr(value, "eqns")]


def _convolution(equation: Any) -> float:
    """Return the FLOPs of a convolution: a kernel of inputs per output value.

    The zeros between the inputs of a transposed strided convolution do not count.
    """
    kernel, spec = equation.invars[1].aval.shape, equation.params["dimension_numbers"].rhs_spec
    out = equation.outvars[0].aval.shape
    taps = prod(kernel) / kernel[spec[0]]
    return 2.0 * prod(out) * taps / prod(equation.params["lhs_dilation"])


def _splash(equation: Any) -> float:
    name, avals = str(equation.params["name"]), [var.aval for var in equation.invars]
    (products,) = (n for beginning, n in SPLASH.items() if name.startswith(beginning))
    # The mask's arrays, of integers, precede queries, keys and values.
    q, k, *_ = (aval.shape for aval in avals if jnp.issubdtype(aval.dtype, jnp.floating))
    return 2.0 * products * prod(q) * k[-2]
