"""The package itself: what importing it costs, and what it never imports."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import egosim_jax

ROOT = Path(egosim_jax.__file__).parent
OPTIONAL = {"torch", "transformers", "diffusers", "wandb", "open3d", "rerun"}


def modules_after(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*sys.modules)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    return {name.partition(".")[0] for name in answer.stdout.decode().split()}


def test_importing_the_package_imports_nothing_heavy():
    assert not modules_after("import egosim_jax") & {"jax", "flax", "numpy", "av", "grain"}


def test_types_know_no_jax():
    assert "jax" not in modules_after("import egosim_jax.types")


def test_help_imports_no_jax():
    code = (
        "from egosim_jax.cli.__main__ import main\ntry: main(['--help'])\nexcept SystemExit: pass"
    )
    assert "jax" not in modules_after(f"exec({code!r})")


@pytest.mark.parametrize("name", egosim_jax.__all__)
def test_every_public_name_is_there(name):
    assert getattr(egosim_jax, name) is not None


def test_optional_packages_are_never_imported_at_module_level():
    offenders = []
    for path in ROOT.rglob("*.py"):
        for node in ast.parse(path.read_text("utf-8")).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            offenders += [f"{path}: {n}" for n in names if n.partition(".")[0] in OPTIONAL]
    assert not offenders
