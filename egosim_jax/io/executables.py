"""Programs that were compiled at an earlier start, ready to run without tracing or compiling.

They lie in a `PrivateCache`, because reading one runs code that is in it. A program is found again
by the digest of all that it depends on: its name and config, the shapes of what it is given, the
devices, the versions of the libraries, XLA's flags, and our own code. What jax compiles besides
lies in another (`share_with_jax`).
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import pickle
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from egosim_jax.io.private import PrivateCache

PACKAGE = Path(__file__).parents[1]
LIBRARIES = ("jax", "jaxlib", "flax")
VARIABLES = ("XLA_FLAGS", "LIBTPU_INIT_ARGS")
FOLDER, MOST = "executables", 64
"""Name of the cache, and how many programs it keeps."""
OF_JAX, MOST_OF_JAX = "jax", 1024
"""Name of the cache of what jax compiles by itself, and how many programs it keeps."""


def kept(about: Any, given: Any, compile: Callable[[], Any]) -> Any:
    """The compiled program that `about` names, of arrays or shapes `given`, compiled only once.

    Where nothing can be kept, because the folder is not the user's alone or several processes share
    the program, it is compiled.
    """
    from jax.experimental import serialize_executable

    if jax.process_count() > 1 or (cache := PrivateCache.open(FOLDER, most=MOST)) is None:
        return compile()
    name = _digest(about, given)
    if (data := cache.get(name)) is not None:
        try:
            return serialize_executable.deserialize_and_load(*pickle.loads(data))  # noqa: S301
        except Exception as error:  # whatever is wrong with it, it can be made again
            warnings.warn(f"{name} cannot be used and is compiled again: {error}", stacklevel=2)
    with _anew():
        compiled = compile()
    try:
        cache.put(name, pickle.dumps(serialize_executable.serialize(compiled)))
    except (ValueError, NotImplementedError) as error:  # programs that cannot be serialized
        warnings.warn(f"{name} was not kept: {error}", stacklevel=2)
    return compiled


def share_with_jax() -> None:
    """Let jax keep what it compiles in a `PrivateCache`, too, unless its user chose a folder.

    Its own files have no checksum where it compresses with zstandard, and it takes them from
    anybody.
    """
    from jax._src import compilation_cache

    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    if (cache := PrivateCache.open(OF_JAX, most=MOST_OF_JAX)) is None:
        return
    original = compilation_cache.get_file_cache

    class Checked(compilation_cache.CacheInterface):
        _path = cache.folder

        def get(self, key: str) -> Any:
            return cache.get(key)

        def put(self, key: str, value: bytes) -> None:
            cache.put(key, value)

    def choose(path: str) -> Any:
        return (Checked(), path) if path == str(cache.folder) else original(path)

    compilation_cache.get_file_cache = choose
    jax.config.update("jax_compilation_cache_dir", str(cache.folder))


@contextmanager
def _anew() -> Iterator[None]:
    """Compile without jax's own cache: a CPU's program that comes from it cannot be written again.

    What was written would lack the program's functions, and say so when it is run.
    """
    from jax.experimental.compilation_cache import compilation_cache

    enabled = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()  # which remembers whether it is used
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", enabled)
        compilation_cache.reset_cache()


def _digest(about: Any, given: Any) -> str:
    leaves = jax.tree_util.tree_flatten_with_path(given)[0]
    devices = jax.devices()
    parts = {
        "about": repr(about),
        "given": [
            [jax.tree_util.keystr(path), leaf.shape, str(leaf.dtype), _where(leaf)]
            for path, leaf in leaves
        ],
        "devices": [devices[0].device_kind, len(devices), devices[0].client.platform_version],
        "precision": jax.config.values["jax_default_matmul_precision"],
        "wide": jax.config.values["jax_enable_x64"],
        "versions": [metadata.version(name) for name in LIBRARIES],
        "variables": [os.environ.get(name) for name in VARIABLES],
        "processor": _processor(),
        "code": _code(),
    }
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _where(leaf: Any) -> str:
    sharding = getattr(leaf, "sharding", None)
    return "" if sharding is None else f"{sharding} {getattr(sharding, 'mesh', '')}"


@functools.cache
def _processor() -> str:
    """What this processor can do: a home may be shared by machines of several kinds."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


@functools.cache
def _code() -> str:
    """Of this package, whose functions are what is compiled."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
