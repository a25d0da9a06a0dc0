"""Tests that judge a file: they import it, directly or through other modules.

    python -m tests.imports FILE... --seconds 90

runs the plain tests of changed files, the closest first, and stops when the time is over.
"""

import argparse
import re
import sys
import time
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
IMPORTS = re.compile(r"^ *from ([\w.]+) import (?:\(([^)]*)\)|(.*))$", re.M)


@cache
def file_of(module: str) -> Path | None:
    """Return the file of a module of this repository."""
    path = ROOT.joinpath(*module.split("."))
    files = (path.with_suffix(".py"), path / "__init__.py")
    return next((file.resolve() for file in files if file.is_file()), None)


def imported(file: Path) -> dict[str, str]:
    """Return the module of each name that a file imports; of a plain import, the module's own."""
    text = re.sub(r"#.*", "", file.read_text())
    names = {module: module for module in re.findall(r"^ *import ([\w.]+)", text, re.M)}
    for module, several, one in IMPORTS.findall(text):
        names |= dict.fromkeys(re.findall(r"(\w+)(?: as \w+)?", several or one), module)
    return names


@cache
def source_of(package: str, name: str) -> str:
    """Return the module that defines a name which a module or package offers."""
    if package != name and file_of(f"{package}.{name}"):
        return f"{package}.{name}"
    file = file_of(package)
    if file and file.name == "__init__.py" and name in (names := imported(file)):
        return source_of(names[name], name)
    return package


@cache
def imports(file: Path) -> frozenset[Path]:
    """Return the files of this repository that a file imports."""
    modules = {source_of(module, name) for name, module in imported(file).items()}
    return frozenset(path for module in modules if (path := file_of(module)))


def judges(tests: list[Path], steps: int) -> dict[Path, list[Path]]:
    """Return the tests that reach each file by so many imports, the closest first."""
    reached: dict[Path, list[tuple[bool, int, Path]]] = {}
    for test in tests:
        frontier, seen = {test}, set()
        for step in range(steps + 1):
            for path in frontier:
                reached.setdefault(path, []).append((path.stem not in test.stem, step, test))
            seen |= frontier
            frontier = {file for path in frontier for file in imports(path)} - seen
    return {path: [test for *_, test in sorted(closest)] for path, closest in reached.items()}


class Deadline:
    """Stop of a run of tests after some seconds."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.end = seconds, time.monotonic() + seconds

    def pytest_runtest_logfinish(self) -> None:
        """Start no other test when the time is over."""
        if time.monotonic() > self.end:
            pytest.exit(f"{self.seconds:g} s are over: the other tests did not run.", returncode=0)


def main() -> None:
    """Run the tests of files; end with the exit code of pytest."""
    parser = argparse.ArgumentParser(description="Run the plain tests of changed files.")
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--seconds", type=float, default=90)
    options = parser.parse_args()
    tests = [
        path for path in sorted(ROOT.glob("tests/*/**/test_*.py")) if "system" not in path.parts
    ]
    closest = judges(tests, 2)
    chosen = [test for file in options.files for test in closest.get(file.resolve(), [])]
    if chosen:
        names = [str(test) for test in dict.fromkeys(chosen)]
        code = pytest.main(["-q", "-n0", *names], plugins=[Deadline(options.seconds)])
        sys.exit(0 if code == pytest.ExitCode.NO_TESTS_COLLECTED else code)


if __name__ == "__main__":
    main()
