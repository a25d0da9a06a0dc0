"""Compiled functions of networks: inference is jitted here."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from flax import nnx
from jax.sharding import Mesh, NamedSharding

from egosim_jax.io.executables import cached_compile
from egosim_jax.runtime.phases import phase
from egosim_jax.sharding import check_batch, spec

Axes = tuple[str | None, ...]
"""Logical axes of an activation (`sharding.ACTIVATIONS`)."""
BATCH: Axes = ("batch",)
"""Axes of an array with a leading batch axis."""


class CompiledFn:
    """A function of networks and arrays, compiled once for each shape of its arguments.

    On a mesh, `shard_params` must have placed the networks. `in_axes` and `out_axes` are the
    logical axes of the arrays of each argument and of each result; by default, all arrays have a
    leading batch axis. The first array always has it. Raises `InputError` before compiling if the
    mesh does not divide the batch. With a `cache_key`, which identifies function and config,
    compiled programs are cached on disk (`io/executables.py`).
    """

    def __init__(
        self,
        function: Callable[..., Any],
        networks: Any,
        *,
        mesh: Mesh | None = None,
        cache_key: Any = None,
        in_axes: Sequence[Axes] | None = None,
        out_axes: Sequence[Axes] | None = None,
        **options: Any,
    ):
        graph, self._params = nnx.split(networks, nnx.Param)
        self._mesh, self._cache_key, self._in_axes = mesh, cache_key, in_axes
        if mesh is not None:
            shardings = [NamedSharding(mesh, spec(*axes)) for axes in out_axes or (BATCH,)]
            options["out_shardings"] = shardings[0] if out_axes is None else tuple(shardings)
        # `nnx.jit` would traverse the networks at every call.
        self._jit = jax.jit(lambda p, *args: function(nnx.merge(graph, p), *args), **options)
        self._compiled: dict[Any, Any] = {}

    def trace(self, *args: Any) -> Any:
        """Return the trace of `jax.jit` for these arguments, arrays or shapes."""
        with self._on_mesh():
            return self._jit.trace(self._params, *self._placed(args))

    def compile(self, *args: Any, about: str = "") -> bool:
        """Compile for these arguments, arrays or shapes; return True if the cache had it.

        `about` names the function to the user, by default by its cache key.
        """
        placed, was_cached = self._placed(args), True

        def compile() -> Any:
            nonlocal was_cached
            was_cached = False
            return self._jit.lower(self._params, *placed).compile()

        with self._on_mesh():
            if self._cache_key is None:
                with phase("compiles a function"):
                    compiled = compile()
            else:
                given, about = (self._params, placed), about or self._cache_key[0]
                compiled = cached_compile(self._cache_key, given, compile, about=about)
        self._compiled[_signature(args)] = compiled
        return was_cached

    def shapes(self, *args: Any) -> Any:
        """Return the shapes and dtypes of the results."""
        compiled = self._compiled.get(_signature(args))
        return (compiled or self.trace(*args)).out_info

    def _placed(self, args: tuple) -> tuple:
        """Return the shapes and shardings of arguments."""
        shardings = self._shardings(args)
        if self._mesh is not None:
            check_batch(jax.tree.leaves(args)[0].shape[0], self._mesh)
        return tuple(
            jax.tree.map(
                lambda leaf, sharding=sharding: jax.ShapeDtypeStruct(
                    leaf.shape, leaf.dtype, sharding=sharding
                ),
                arg,
            )
            for arg, sharding in zip(args, shardings, strict=True)
        )

    def _shardings(self, args: tuple) -> tuple[NamedSharding | None, ...]:
        """Return the sharding of the arrays of each argument; None on one device."""
        if self._mesh is None:
            return (None,) * len(args)
        axes = self._in_axes or (BATCH,) * len(args)
        return tuple(NamedSharding(self._mesh, spec(*dims)) for dims in axes)

    def __call__(self, *args: Any) -> Any:
        """Run the function; compile it first if necessary."""
        if (signature := _signature(args)) not in self._compiled:
            self.compile(*args)
        if self._mesh is not None:
            args = jax.device_put(args, self._shardings(args))
        return self._compiled[signature](self._params, *args)

    def _on_mesh(self) -> contextlib.AbstractContextManager[Any]:
        return contextlib.nullcontext() if self._mesh is None else jax.set_mesh(self._mesh)


def _signature(args: Any) -> Any:
    return tuple((leaf.shape, np.dtype(leaf.dtype)) for leaf in jax.tree.leaves(args))
