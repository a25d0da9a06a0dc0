"""Persistent cache of compiled functions and traced networks, which need no trace or compilation.

The files are in a `PrivateCache`, because reading one runs native code in it. Its key is the digest
of everything that the compiled function depends on: its name and config, the shapes of its
arguments, the devices, the versions of the libraries, XLA's flags, the modules of this package that
run while it is traced, and other packages whose classes are in the config. jax's own compilation
cache is in another private folder (`share_with_jax`).
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import pickle
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from egosim_jax.io.private import PrivateCache, private_folder
from egosim_jax.runtime.phases import phase

PACKAGE = Path(__file__).parents[1]
LIBRARIES = ("jax", "jaxlib", "flax")
VARIABLES = ("XLA_FLAGS", "LIBTPU_INIT_ARGS")
TRACED = (
    "conditioning", "configs/model.py", "diffusion", "generation/causal.py",
    "generation/compiled.py", "generation/denoising.py", "generation/encoding.py",
    "generation/generator.py", "generation/stream.py", "models", "sharding.py", "types",
)  # fmt: skip
"""Modules that run while a function is traced, and so determine the compiled program."""
FOLDER, MAX_FILES = "executables", 128
"""Name of the cache, and its maximum number of compiled functions and traced networks."""
JAX_FOLDER, JAX_MAX_FILES = "jax", 1024
"""Name of jax's own compilation cache, and the number of files that a start leaves in it."""
JAX_MIN_SECONDS = 0.03
"""Minimum time to compile a function that jax stores; by default a second, so no renderer is."""
JAX_MIN_SECONDS_VARIABLE = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"


def cached_compile(
    key: Any, args: Any, compile_fn: Callable[[], Any], *, about: str = "a function"
) -> Any:
    """Return the compiled function of this key and these arguments, from the cache if it is there.

    `args` are arrays or shapes; `about` names the function to the user. Without a private folder,
    with several processes, or with a class in the key whose source is not in a file, it is compiled
    and not stored.
    """
    from jax.experimental import serialize_executable

    sources = _sources(key)
    alone = sources is not None and jax.process_count() == 1
    cache = PrivateCache.open(FOLDER, most=MAX_FILES) if alone else None
    if cache is None:
        with phase(f"compiles {about}"):
            return compile_fn()
    name = _digest((key, sources), args)
    if (data := cache.get(name)) is not None:
        try:
            with phase(f"loads {about}", only_if_long=True):
                return serialize_executable.deserialize_and_load(
                    *pickle.loads(data),  # noqa: S301
                    execution_devices=_devices(args),
                )
        except Exception as error:  # whatever is wrong with it, it can be compiled again
            _warn_unusable(name, error)
    with phase(f"compiles {about}; cached next time"), _without_jax_cache():
        compiled = compile_fn()
    try:
        cache.put(name, pickle.dumps(serialize_executable.serialize(compiled)))
    except (ValueError, NotImplementedError) as error:  # cannot be serialized
        warnings.warn(f"{name} was not stored: {error}", stacklevel=2)
    return compiled


def cached_trace(key: Any, trace_fn: Callable[[], Any]) -> Any:
    """Return the network of shapes that is traced from a key, from the cache if it is there.

    It depends only on the key and the code. It is not stored if `cached_compile` would not store
    with this key, or if it holds a function that has no importable name.
    """
    sources = _sources(key)
    if sources is None or (cache := PrivateCache.open(FOLDER, most=MAX_FILES)) is None:
        return trace_fn()
    name = _hash({"key": repr((key, sources)), **_tracing()})
    if (data := cache.get(name)) is not None:
        try:
            return pickle.loads(data)  # noqa: S301
        except Exception as error:  # whatever is wrong with it, it can be traced again
            _warn_unusable(name, error)
    traced = trace_fn()
    with suppress(pickle.PicklingError, AttributeError, TypeError):
        cache.put(name, pickle.dumps(traced))
    return traced


def _warn_unusable(name: str, error: Exception) -> None:
    warnings.warn(f"{name} cannot be used and is made again: {error}", stacklevel=3)


def share_with_jax() -> None:
    """Keep jax's own compilation cache in a private folder, unless the user chose a folder.

    For entry points, since it changes jax's settings.
    """
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    # Not jax_compilation_cache_max_size: before jax 0.12, one file whose write was cut off keeps
    # jax from storing any other (jax issue 39880).
    if (folder := private_folder(JAX_FOLDER, most=JAX_MAX_FILES)) is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        if JAX_MIN_SECONDS_VARIABLE not in os.environ:
            jax.config.update(JAX_MIN_SECONDS_VARIABLE.lower(), JAX_MIN_SECONDS)


@contextmanager
def _without_jax_cache() -> Iterator[None]:
    """Compile without jax's own cache: CPU executables loaded from it cannot be serialized again.

    The file would lack their functions, and fail when it is run.
    """
    from jax.experimental.compilation_cache import compilation_cache

    enabled = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()  # it stores whether it is used
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", enabled)
        compilation_cache.reset_cache()


def _digest(key: Any, args: Any) -> str:
    leaves = jax.tree_util.tree_flatten_with_path(args)[0]
    devices = jax.devices()
    parts = {
        "key": repr(key),
        "args": [
            [jax.tree_util.keystr(path), leaf.shape, str(leaf.dtype), _sharding(leaf)]
            for path, leaf in leaves
        ],
        "devices": [devices[0].device_kind, len(devices), devices[0].client.platform_version],
        "precision": jax.config.values["jax_default_matmul_precision"],
        "variables": [os.environ.get(name) for name in VARIABLES],
        "processor": _processor(),
        **_tracing(),
    }
    return _hash(parts)


def _tracing() -> dict[str, Any]:
    """Return what any trace depends on."""
    return {
        "wide": jax.config.values["jax_enable_x64"],
        "versions": [metadata.version(name) for name in LIBRARIES],
        "code": _code(),
    }


def _hash(parts: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _sharding(leaf: Any) -> str:
    sharding = getattr(leaf, "sharding", None)
    return "" if sharding is None else f"{sharding} {getattr(sharding, 'mesh', '')}"


def _devices(args: Any) -> list[Any]:
    """Return the devices of a mesh in its order, or the only one that has arguments.

    By default, jax would load a function of one device for all devices of the machine.
    """
    shardings = [getattr(leaf, "sharding", None) for leaf in jax.tree.leaves(args)]
    for sharding in shardings:
        if isinstance(sharding, jax.sharding.NamedSharding):
            mesh: Any = sharding.mesh
            return list(mesh.devices.flat)
    used = {device for s in shardings if s is not None for device in s.device_set}
    return list(used) or jax.devices()[:1]


@functools.cache
def _processor() -> str:
    """Return the CPU's feature flags: machines of several kinds may share a home folder."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


@functools.cache
def _code() -> str:
    """Return the digest of the modules that run while a function is traced."""
    digest = hashlib.sha256()
    for name in TRACED:
        path = PACKAGE / name
        for module in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(module.read_bytes())
    return digest.hexdigest()


def _sources(key: Any) -> dict[str, str] | None:
    """Return the digest of each module outside this package that defines a class in a key.

    Covers the top-level package of the module. None if a module has no source file.
    """
    sources = {}
    for name in {kind.__module__ for kind in _classes(key)}:
        module = sys.modules[name]
        if (top := _full_name(module).partition(".")[0]) in sys.stdlib_module_names:
            continue
        if (file := getattr(module, "__file__", None)) is None or not file.endswith(".py"):
            return None
        if (own := Path(file).resolve()).is_relative_to(PACKAGE.resolve()):
            continue  # `_code` has it
        folders = [] if top == PACKAGE.name else getattr(sys.modules.get(top), "__path__", [])
        files = {own, *(path for folder in folders for path in Path(folder).rglob("*.py"))}
        digest = hashlib.sha256()
        for path in sorted(files):
            digest.update(path.read_bytes())
        sources[_full_name(module)] = digest.hexdigest()
    return dict(sorted(sources.items()))


def _full_name(module: Any) -> str:
    """Return a module's name; `__main__` of `python -m` has it in its spec."""
    spec = getattr(module, "__spec__", None)
    return module.__name__ if spec is None else spec.name


def _classes(value: Any) -> Iterator[type]:
    """Iterate over the classes, with their bases, of a value and of all that it holds."""
    yield from type(value).__mro__
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _classes(getattr(value, field.name))
    elif isinstance(value, Mapping):
        yield from _classes(tuple(value.values()))
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _classes(item)
