"""Open3D's native module loads alone, and the package can still be imported after it."""

import subprocess
import sys

CODE = """
import sys
from egosim_jax.runtime.open3d import load_open3d
native = load_open3d()
assert native is load_open3d()
assert not {"open3d", "sklearn", "dash", "pandas"} & {*sys.modules}
import open3d
assert open3d.core is native.core and open3d.t.geometry is native.t.geometry
assert load_open3d() is open3d and open3d.visualization.draw_geometries
"""


def test_the_native_module_loads_alone_and_the_package_uses_it():
    subprocess.run([sys.executable, "-c", CODE], check=True)
