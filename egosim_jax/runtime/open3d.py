"""Open3D's native module, without its Python packages.

`import open3d` also imports its plots and machine learning, and with them dash, pandas and
scikit-learn: two of three seconds. Nothing here uses them.
"""

from __future__ import annotations

import sys
import threading
from importlib.abc import Loader
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

PYBIND = "open3d.cpu.pybind"
"""Name of the native module; `import open3d` finds and uses a loaded one."""
_LOCK = threading.Lock()


def load_open3d() -> Any:
    """Return a module with Open3D's `core`, `geometry`, `t` and `utility`.

    Raises `ImportError` if Open3D is not installed.
    """
    with _LOCK:
        if "open3d" not in sys.modules:
            if (loaded := sys.modules.get(PYBIND)) is not None:
                return loaded
            if (spec := _native_spec()) is not None and spec.loader is not None:
                return _load(spec, spec.loader)
        import open3d

        return open3d


def point_cloud(points_m: Float[np.ndarray, "n 3"]) -> Any:
    """Return Open3D's cloud of points; it copies float64 as a block, and other types row by row."""
    o3d = load_open3d()
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m.astype(np.float64)))


def nearest(
    points_m: Float[np.ndarray, "n 3"], others_m: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, " n"]:
    """Return the distance of each point to the nearest of the others; infinite without others."""
    if not len(points_m) or not len(others_m):
        return np.full(len(points_m), np.inf)
    distances = point_cloud(points_m).compute_point_cloud_distance(point_cloud(others_m))
    return np.asarray(distances)


def _native_spec() -> ModuleSpec | None:
    """Return the native module of a build for CPUs; a build for GPUs chooses one of two itself."""
    package = find_spec("open3d")
    folder = Path(*package.submodule_search_locations or ()) if package is not None else Path()
    if package is None or (folder / "cuda").exists():
        return None
    return PathFinder.find_spec(PYBIND, [str(folder / "cpu")])


def _load(spec: ModuleSpec, loader: Loader) -> ModuleType:
    module = sys.modules[PYBIND] = module_from_spec(spec)
    try:
        loader.exec_module(module)
    except BaseException:
        del sys.modules[PYBIND]
        raise
    return module
