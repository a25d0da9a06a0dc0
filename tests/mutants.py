"""Do the tests notice a wrong token?

A mutant is the package with one token changed: an operator, a comparison, a number, and/or, not,
min/max. Messages, strings and type hints stay as they are. The plain tests of its folder that
import the changed module judge it, in a copy of the repository; it is killed if one fails or
`--limit` seconds are over.

    python -m tests.mutants --folders state diffusion --count 30 --seed 0

prints each survivor and the share killed. The log keeps results, so the next call continues;
`--again` judges its survivors again, after a test was added. mutmut and cosmic-ray draw no sample,
and start Python and jax for each mutant.
"""

import argparse
import ast
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib import import_module
from itertools import pairwise
from pathlib import Path

from tests.conftest import CACHE  # sets the environment in which jax is imported
from tests.imports import ROOT, judges

FOLDERS = ["state", "dynamics", "conditioning", "diffusion", "convert/tables", "data"]
IMPORTED = ["scipy.spatial", "jax.numpy", "flax.nnx", "optax", "cv2", "av", "PIL.Image"]
"""Modules that no test waits for; not Open3D, whose allocator has a thread that no fork has."""
PAIRS = [
    *[("+", "-"), ("*", "/"), ("&", "|"), ("<", "<="), (">", ">="), ("==", "!="), ("and", "or")],
    *[("is", "is not"), ("in", "not in"), ("True", "False"), ("min", "max"), ("any", "all")],
    *[("floor", "ceil"), ("minimum", "maximum"), ("argmin", "argmax"), ("sin", "cos")],
]
OTHER = {"**": "*", "//": "/", "%": "*", **dict(PAIRS), **{b: a for a, b in PAIRS}}
OPERATOR = re.compile(r"[)\s]*(//|\*\*|<<|>>|[<>=!]=|[-+*/%&|<>]|is not|not in|and|or|is|in)")
NO_TESTS = 5
"""Exit code of pytest if all tests are marked `slow`."""
SKIPPED = ("annotation", "returns", "decorator_list", "type_params")


def places(tree: ast.AST) -> Iterator[tuple[ast.expr, ast.expr]]:
    """Yield the expressions around each operator, and each number and name twice."""
    for field, value in ast.iter_fields(tree):
        for node in value if isinstance(value, list) else [value]:
            message = isinstance(node, ast.Raise | ast.JoinedStr) or (
                isinstance(node, ast.Call) and re.search("Error$|warn", ast.unparse(node.func))
            )
            if isinstance(node, ast.AST) and field not in SKIPPED and not message:
                yield from places(node)
    match tree:
        case ast.BinOp(left, _, right) | ast.AugAssign(left, _, right):
            yield left, right
        case ast.BoolOp(_, values):
            yield from pairwise(values)
        case ast.Compare(left, _, values):
            yield from pairwise([left, *values])
        case ast.UnaryOp(_, operand):
            yield tree, operand
        case ast.Constant(bool() | int() | float()) | ast.Name() | ast.Attribute():
            yield tree, tree


def mutations(source: str) -> Iterator[tuple[int, int, str]]:
    """Yield (start, stop, replacement), in bytes, for every token that has another."""
    data = source.encode()
    lines = [0]
    for line in data.splitlines(keepends=True):
        lines.append(lines[-1] + len(line))
    for left, right in places(ast.parse(source)):
        start, operand = (lines[node.lineno - 1] + node.col_offset for node in (left, right))
        stop = lines[(left.end_lineno or 0) - 1] + (left.end_col_offset or 0)
        if isinstance(left, ast.UnaryOp) and left.operand is right:
            yield start, operand, "(" * data[start:operand].count(b"(")
        elif left is not right:
            operator = OPERATOR.match(data[stop:operand].decode())
            if operator and operator[1] in OTHER:
                yield stop + operator.start(1), stop + operator.end(1), OTHER[operator[1]]
        elif isinstance(left, ast.Constant) and not isinstance(left.value, bool):
            number = left.value
            others = (number - 1, number + 1) if isinstance(number, int) else (number * 2, 0.1)
            yield from ((start, stop, str(other)) for other in others if other != number)
        elif (word := re.split(r"\W", ast.unparse(left))[-1]) in OTHER:
            yield stop - len(word), stop, OTHER[word]


def ends(copy: Path, tests: list[Path], limit: float) -> str:
    """Run tests in a copy of the repository, in a child with all imports; return how they end."""
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        os.chdir(copy)
        os.environ["PYTHONPATH"] = str(copy)
        sys.dont_write_bytecode = True  # a changed file may be as long and as old as the first
        sys.path[:] = [str(copy), *(path for path in sys.path if path not in ("", str(ROOT)))]
        for name in [name for name in sys.modules if name.split(".")[0] == "tests"]:
            del sys.modules[name]
        output = os.open(copy.parent / "output", os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
        os.dup2(output, 1)
        os.dup2(output, 2)
        names = [str(test.relative_to(ROOT)) for test in tests]
        os._exit(import_module("pytest").main(["-x", "-q", "-n0", "-pno:cacheprovider", *names]))
    end = time.monotonic() + limit
    while (status := os.waitpid(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "killed by time"
        time.sleep(0.02)
    return "survived" if os.waitstatus_to_exitcode(status[1]) in (0, NO_TESTS) else "killed"


def draw(folder: str, count: int, seed: int) -> Iterator[dict]:
    """Yield mutants: the file, the bytes to replace, and the line before and after."""
    drawn = [
        (file.resolve(), *mutation)
        for file in sorted((ROOT / "egosim_jax" / folder).rglob("*.py"))
        for mutation in mutations(file.read_text())
    ]
    for file, start, stop, token in random.Random(seed).sample(drawn, min(count, len(drawn))):
        data = file.read_bytes()
        changed = data[:start] + token.encode() + data[stop:]
        line = data[:start].count(b"\n")
        before, after = (text.decode().splitlines()[line].strip() for text in (data, changed))
        name = f"{file.relative_to(ROOT)}:{line + 1}"
        yield {"name": name, "before": before, "after": after, "file": file, "changed": changed}


def judge(
    mutants: list[dict], folder: str, limit: float, *, passing: bool
) -> Iterator[tuple[dict, str]]:
    """Yield each mutant and its end, once all tests are `passing` without a change."""
    unit = ROOT / "tests/unit" / folder.split("/")[0]
    reaching = judges(sorted(unit.rglob("test_*.py")), 9)
    for file, tests in judges(sorted(ROOT.glob("tests/properties/test_*.py")), 1).items():
        reaching.setdefault(file, []).extend(tests)
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "copy"
        tracked = subprocess.check_output(
            ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT
        )
        for name in tracked.decode().splitlines():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            if (ROOT / name).exists():
                shutil.copy2(ROOT / name, copy / name, follow_symlinks=False)
        everything = sorted({test for m in mutants for test in reaching.get(m["file"], [])})
        if not passing and everything and ends(copy, everything, 10 * limit) != "survived":
            sys.exit((Path(place) / "output").read_text())
        for mutant in mutants:
            path = copy / mutant["file"].relative_to(ROOT)
            unchanged = path.read_bytes()
            path.write_bytes(mutant["changed"])
            tests = reaching.get(mutant["file"])
            yield mutant, ends(copy, tests, limit) if tests else "survived"
            path.write_bytes(unchanged)


def main() -> None:
    """Judge mutants; print the survivors and the share killed."""
    parser = argparse.ArgumentParser(description="Do the tests notice a wrong token?")
    parser.add_argument("--folders", nargs="+", default=FOLDERS)
    parser.add_argument("--count", type=int, default=25, help="mutants of each folder")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=300, help="seconds of a mutant's tests")
    parser.add_argument("--again", action="store_true", help="judge the log's survivors again")
    parser.add_argument("--log", type=Path, default=CACHE / "mutants.jsonl")
    options = parser.parse_args()
    for module in IMPORTED:
        import_module(module)
    options.log.parent.mkdir(exist_ok=True)
    options.log.touch()
    logged = [json.loads(line) for line in options.log.read_text().splitlines()]
    past = {(m["name"], m["after"]): m["end"] for m in logged}
    for folder in options.folders:
        drawn = list(draw(folder, options.count, options.seed))
        open_ends = (None, "survived") if options.again else (None,)
        new = [m for m in drawn if past.get((m["name"], m["after"])) in open_ends]
        judged = [past.get((m["name"], m["after"])) for m in drawn]
        passing = "survived" in judged and not options.again  # what survived passed all tests
        for mutant, end in judge(new, folder, options.limit, passing=passing):
            past[mutant["name"], mutant["after"]] = end
            with options.log.open("a") as log:
                kept = {key: mutant[key] for key in ("name", "before", "after")}
                print(json.dumps(kept | {"end": end}), file=log)
        survivors = [m for m in drawn if past[m["name"], m["after"]] == "survived"]
        for mutant in survivors:
            print(f"{mutant['name']}\n  - {mutant['before']}\n  + {mutant['after']}")
        print(f"{folder}: {len(drawn) - len(survivors)} of {len(drawn)} killed", flush=True)


if __name__ == "__main__":
    main()
