"""The package itself: what importing it costs, and what it never imports."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import egosim_jax

ROOT = Path(egosim_jax.__file__).parent
OPTIONAL = {"torch", "transformers", "diffusers", "wandb", "open3d", "rerun"}

CLONE = ROOT.parent


def modules_after(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*sys.modules)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    return {name.partition(".")[0] for name in answer.stdout.decode().split()}


def test_importing_the_package_imports_nothing_heavy():
    assert not modules_after("import egosim_jax") & {"jax", "flax", "numpy", "av", "grain"}
    assert "numpy" not in modules_after("import egosim_jax.cli.__main__")  # prints its first line


def test_package_citation_and_changelog_have_one_version():
    project = tomllib.loads((CLONE / "pyproject.toml").read_text("utf-8"))["project"]
    (cited,) = re.findall(r"^version: (.*)$", (CLONE / "CITATION.cff").read_text("utf-8"), re.M)
    released = re.findall(r"^## (\S+)", (CLONE / "CHANGELOG.md").read_text("utf-8"), re.M)
    newest = next(version for version in released if version != "Unreleased")
    assert project["version"] == cited == newest


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


def parsed(text: str) -> tuple:
    """Return a requirement in a form to compare."""
    need = Requirement(text)
    return (
        canonicalize_name(need.name),
        *map(str, (sorted(need.extras), need.specifier, need.marker)),
    )


def test_the_lock_file_is_of_the_requirements_of_the_project():
    """Otherwise: `uv lock`."""
    project = tomllib.loads((CLONE / "pyproject.toml").read_text("utf-8"))["project"]
    wanted = {parsed(text) for text in project["dependencies"]}
    for extra, needs in project["optional-dependencies"].items():
        for text in needs:
            name, _, marker = text.partition(";")
            both = f"{marker.strip()} and extra == '{extra}'" if marker else f"extra == '{extra}'"
            wanted.add(parsed(f"{name}; {both}"))
    lock = tomllib.loads((CLONE / "uv.lock").read_text("utf-8"))
    (ours,) = (package for package in lock["package"] if package["name"] == project["name"])
    locked = set()
    for need in ours["metadata"]["requires-dist"]:
        text = f"{need['name']}[{','.join(need.get('extras', ()))}]{need.get('specifier', '')}"
        marker = need.get("marker", "").replace("python_full_version", "python_version")
        locked.add(parsed(f"{text}; {marker}" if marker else text))
    assert locked == wanted


def test_the_lock_file_installs_from_the_public_index_alone():
    lock = tomllib.loads((CLONE / "uv.lock").read_text("utf-8"))
    files = [file["url"] for p in lock["package"] for file in p.get("wheels", ())]
    sources = [p["source"]["registry"] for p in lock["package"] if "registry" in p["source"]]
    hosts = {urlsplit(address).netloc for address in (*files, *sources)}
    assert hosts == {"files.pythonhosted.org", "pypi.org"}
