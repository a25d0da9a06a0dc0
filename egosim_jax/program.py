"""A function of networks, compiled, and where their weights lie: only here inference is jitted."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from flax import nnx
from jax.sharding import Mesh, PartitionSpec

from egosim_jax.io.executables import cached_compile, share_with_jax
from egosim_jax.sharding import batch_sharding, check_batch, several_devices, state_sharding

Module = TypeVar("Module")


class Program:
    """A function of the networks and arrays, compiled once for each shape of its arguments.

    On a mesh, on which `place` has put the networks, all arrays have a leading batch axis. Raises
    `InputError` before compiling for a batch that the mesh does not divide. What is `about` tells
    the function from others; a program that has it is kept between starts (`io/executables.py`).
    """

    def __init__(
        self,
        function: Callable[..., Any],
        networks: Any,
        *,
        mesh: Mesh | None = None,
        about: Any = None,
        **options: Any,
    ):
        share_with_jax()
        graph, self._params = nnx.split(networks, nnx.Param)
        self._mesh, self._about = mesh, about
        if mesh is not None:
            options["out_shardings"] = batch_sharding(mesh)
        self._jit = jax.jit(lambda p, *args: function(nnx.merge(graph, p), *args), **options)
        self._compiled: dict[Any, Any] = {}

    def trace(self, *args: Any) -> Any:
        """The program for these arguments, arrays or shapes, as `jax.jit` traces it."""
        with self._on_mesh():
            return self._jit.trace(self._params, *self._placed(args))

    def compile(self, *args: Any) -> Any:
        """Compile for these arguments, arrays or shapes, or find what was compiled before."""
        given = self._placed(args)

        def compile() -> Any:
            return self._jit.lower(self._params, *given).compile()

        with self._on_mesh():
            compiled = (
                compile()
                if self._about is None
                else cached_compile(self._about, (self._params, given), compile)
            )
        self._compiled[_signature(args)] = compiled
        return compiled

    def shapes(self, *args: Any) -> Any:
        """The shapes of the answer."""
        compiled = self._compiled.get(_signature(args))
        return (compiled or self.trace(*args)).out_info

    def _placed(self, args: tuple) -> tuple:
        """The shapes of arguments, on their devices."""
        placed = None
        if self._mesh is not None:
            check_batch(jax.tree.leaves(args)[0].shape[0], self._mesh)
            placed = batch_sharding(self._mesh)
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=placed), args
        )

    def __call__(self, *args: Any) -> Any:
        """Run, compiling first if nobody has."""
        if (signature := _signature(args)) not in self._compiled:
            self.compile(*args)
        if self._mesh is not None:
            args = jax.device_put(args, batch_sharding(self._mesh))
        return self._compiled[signature](self._params, *args)

    def _on_mesh(self) -> contextlib.AbstractContextManager[Any]:
        return contextlib.nullcontext() if self._mesh is None else jax.set_mesh(self._mesh)


def _signature(args: Any) -> Any:
    return tuple((leaf.shape, np.dtype(leaf.dtype)) for leaf in jax.tree.leaves(args))


def place(networks: Module, mesh: Mesh | None) -> Module:
    """Networks whose weights lie on a mesh as the rules say; the same ones without a mesh.

    The weights may be shapes: then they are those of weights that would lie there.
    """
    if mesh is None:
        return networks
    graph, params = nnx.split(networks, nnx.Param)
    placed = jax.tree.map(_put, params, state_sharding(mesh, params))
    return nnx.merge(graph, placed)


def _put(leaf: Any, sharding: Any) -> Any:
    """An array on its devices; a shape, of an array that would lie there."""
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)
    return jax.device_put(leaf, sharding)


def gathered(network: Module) -> Module:
    """The network, its weights fetched whole to every device, which then works by itself."""
    if not several_devices():
        return network
    graph, params = nnx.split(network)
    return nnx.merge(graph, jax.lax.with_sharding_constraint(params, PartitionSpec()))
