"""Optax transformations on groups of equal matrices, instead of on each weight.

Muon multiplies every matrix by itself many times. A small model has dozens of small matrices, whose
products a GPU finishes faster than it starts them. Stacked, matrices of one shape share a batched
product, and all other weights are one vector:

    weights  ->  {"256x768": [n, 256, 768], ..., "others": [m]}  ->  updates  ->  weights

A matrix with more rows than columns is transposed, which Muon's update follows exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from optax.contrib import MuonDimensionNumbers

OTHERS = "others"
"""Name of the vector of all weights that are no matrices."""

Dimensions = Callable[[nnx.Variable], MuonDimensionNumbers | None]


@dataclass(frozen=True)
class Member:
    """A leaf's place in its group."""

    index: int
    """Index of the leaf."""
    count: int
    """Number of its matrices or, in the vector, of its values."""
    rows: int
    """Rows of each matrix: its input features."""
    tall: bool
    """True if the group has its transpose."""


def grouped(
    inner: optax.GradientTransformation, dimensions: Dimensions
) -> optax.GradientTransformation:
    """Return `inner` on the groups of a tree of nnx variables.

    `dimensions` returns the axes of a matrix `[n?, ..., in, out]`, else None. The state of `inner`
    has the groups' shapes and is replicated on a mesh.
    """

    def init(params: Any) -> Any:
        return inner.init(_pack(params, _plan(params, dimensions)))

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        if params is None:
            raise ValueError("grouped transformations need the weights, for their axes")
        plan = _plan(params, dimensions)
        packed: Any = _pack(updates, plan)
        packed, state = inner.update(packed, state, _pack(params, plan))
        return _unpack(packed, updates, plan), state

    return optax.GradientTransformation(init, update)


def group_dimensions(groups: Any) -> Any:
    """Return Muon's axes of each group: rows and columns of its stacked matrices."""
    return {name: None if name == OTHERS else MuonDimensionNumbers((1,), 2) for name in groups}


def _plan(params: Any, dimensions: Dimensions) -> dict[str, list[Member]]:
    """Return the members of each group, in the order of the leaves."""
    groups: dict[str, list[Member]] = {}
    leaves = jax.tree.leaves(params, is_leaf=lambda leaf: isinstance(leaf, nnx.Variable))
    for index, leaf in enumerate(leaves):
        axes, shape = dimensions(leaf), tuple(leaf.shape)
        if axes is None:
            groups.setdefault(OTHERS, []).append(Member(index, prod(shape), 1, False))
            continue
        columns = shape[-1]
        count = prod(shape[: _first(axes)])
        rows = prod(shape[_first(axes) : -1])
        name = f"{min(rows, columns)}x{max(rows, columns)}"
        groups.setdefault(name, []).append(Member(index, count, rows, rows > columns))
    return groups


def _first(axes: MuonDimensionNumbers) -> int:
    """Return the first axis of a matrix's rows."""
    rows = axes.reduction_axis
    return rows if isinstance(rows, int) else min(rows)


def _pack(tree: Any, plan: Mapping[str, list[Member]]) -> dict[str, jax.Array]:
    """Return the groups of a tree's leaves."""
    leaves = jax.tree.leaves(tree)

    def shaped(member: Member, name: str) -> jax.Array:
        leaf = leaves[member.index]
        if name == OTHERS:
            return leaf.reshape(-1)
        matrices = leaf.reshape(member.count, member.rows, -1)
        return matrices.mT if member.tall else matrices

    return {
        name: jnp.concatenate([shaped(member, name) for member in members])
        for name, members in plan.items()
    }


def _unpack(groups: Mapping[str, jax.Array], like: Any, plan: Mapping[str, list[Member]]) -> Any:
    """Return the tree of groups, with the shapes of the leaves of `like`."""
    leaves, structure = jax.tree.flatten(like)
    for name, members in plan.items():
        start = 0
        for member in members:
            part = groups[name][start : start + member.count]
            part = part.mT if member.tall else part
            leaves[member.index] = part.reshape(leaves[member.index].shape)
            start += member.count
    return jax.tree.unflatten(structure, leaves)
