"""docs/architecture.md names functions and folders that exist, and the layers of the contract."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text()
FUNCTIONS = sorted(set(re.findall(r"`([\w/]+\.py):([\w.]+)`", PAGE)))
FILES = sorted(set(re.findall(r"`((?:egosim_jax|train|convert)/[\w/]+?(?:\.py)?)[:`]", PAGE)))


def names(node):
    """The names that a statement defines: a function, a class, or a value."""
    targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
    return [getattr(node, "name", None), *(getattr(target, "id", None) for target in targets)]


@pytest.mark.parametrize(("file", "name"), FUNCTIONS)
def test_a_named_function_exists(file, name):
    scope = ast.parse((ROOT / file).read_text()).body
    for step in name.split("."):
        named = {key: node for node in scope for key in names(node)}
        assert step in named, f"{file} has no {name}"
        scope = getattr(named[step], "body", [])


def test_all_three_call_paths_are_named():
    assert len(FUNCTIONS) >= 20


@pytest.mark.parametrize("file", FILES)
def test_a_named_file_exists(file):
    assert (ROOT / file).exists()


def test_the_tree_has_every_entry_of_the_package():
    tree = set(re.findall(r"^    (\w+)(?:/|\.py)  ", PAGE, re.M))
    package = {
        path.stem
        for path in (ROOT / "egosim_jax").iterdir()
        if (path / "__init__.py").exists() or path.suffix == ".py"
    }
    assert tree == package - {"__init__", "__main__"}


def test_the_rows_are_the_layers_of_the_import_contract():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    contracts = settings["tool"]["importlinter"]["contracts"]
    layers = next(c["layers"] for c in contracts if c.get("containers") == ["egosim_jax"])
    tree = PAGE[PAGE.index("    cli/") : PAGE.index("`train` and `convert` are")]
    rows = [re.findall(r"^    (\w+)", row, re.M) for row in tree.strip("\n").split("\n\n")]
    assert [" | ".join(row) for row in rows] == layers[1:]  # without `__main__`
