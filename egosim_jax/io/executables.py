"""Programs that were compiled at an earlier start, ready to run without tracing or compiling.

They lie in a folder that belongs to the user and that nobody else can read or write, because
reading one runs code that is in it: `~/.cache/egosim_jax/executables`. A program is found again by
the digest of all that it depends on: its name and config, the shapes of what it is given, the
devices, the versions of the libraries, XLA's flags, and our own code.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import pickle
import stat
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from egosim_jax.command import cache_folder
from egosim_jax.io.atomic import atomic_write

PACKAGE = Path(__file__).parents[1]
LIBRARIES = ("jax", "jaxlib", "flax")
VARIABLES = ("XLA_FLAGS", "LIBTPU_INIT_ARGS")
MOST = 64
"""Programs that are kept: those that were used last."""


def kept(about: Any, given: Any, compile: Callable[[], Any]) -> Any:
    """The compiled program that `about` names, of arrays or shapes `given`, compiled only once.

    Where nothing can be kept, because the folder is not the user's alone or several processes share
    the program, it is compiled.
    """
    folder = _folder()
    if folder is None or jax.process_count() > 1:
        return compile()
    path = folder / _digest(about, given)
    if path.exists():
        try:
            return _read(path)
        except Exception as error:  # whatever is wrong with it, it can be made again
            warnings.warn(f"{path} cannot be used, so it is compiled again: {error}", stacklevel=2)
    with _anew():
        compiled = compile()
    _write(path, compiled)
    return compiled


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


def _folder() -> Path | None:
    """The folder, if it is the user's own."""
    folder = cache_folder() / "executables"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except OSError:
        return None
    private = found.st_uid == os.getuid() and not stat.S_IMODE(found.st_mode) & 0o077
    return folder if private else None


def _read(path: Path) -> Any:
    from jax.experimental import serialize_executable

    path.touch()
    return serialize_executable.deserialize_and_load(*pickle.loads(path.read_bytes()))  # noqa: S301


def _write(path: Path, compiled: Any) -> None:
    from jax.experimental import serialize_executable

    try:
        data = pickle.dumps(serialize_executable.serialize(compiled))
        with atomic_write(path) as temporary:
            temporary.write_bytes(data)
        files = sorted(path.parent.iterdir(), key=lambda file: file.stat().st_mtime)
        for old in files[:-MOST]:
            old.unlink(missing_ok=True)
    # A full disk, or a platform whose programs cannot be serialised.
    except (OSError, ValueError, NotImplementedError) as error:
        warnings.warn(f"{path} was not kept: {error}", stacklevel=2)


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
