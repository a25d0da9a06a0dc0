"""Conditions that hold wherever a writer is killed.

What was complete before is still there complete, in its old or its new version; and the same
writer, run again, leaves what it leaves if it is never killed, with no temporary name.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from egosim_jax.io.atomic import LOCK
from tests.crash.points import watch
from tests.crash.writers import WRITERS, Writer, inputs

MANY, SAMPLE = 200, 60
"""Maximum number of points tried for one writer, drawn by the seed."""


@dataclass
class Report:
    """Results of the crash points of a writer."""

    name: str
    changes: int
    points: int = 0
    torn: int = 0
    """Number of the points at which a write was half done."""
    failures: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        sample = " (a sample)" if self.points < self.changes else ""
        tried = f"{self.points} points tried{sample}, {self.torn} of them within a write"
        return f"{self.name}: {self.changes} changes, {tried}, {len(self.failures)} failures"


def check(name: str, work: Path, *, seed: int = 0, most: int | None = None) -> Report:
    """Kill a writer before each of its changes, and within each of its writes.

    `most` draws so many points.
    """
    writer, shared, work = WRITERS[name], work / "inputs", work / name
    if not shared.exists():
        forked(lambda: inputs(shared), shared.parent)
    shutil.rmtree(work, ignore_errors=True)
    place = work / "place"
    place.mkdir(parents=True)
    if writer.before:
        forked(lambda: writer.write(place, shared, 0), work)
    before = forked(lambda: dict(writer.read(place)), work) if writer.before else {}
    place.rename(work / "before")

    def start() -> Path:
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(work / "before", place, symlinks=True)
        return place

    def write() -> None:
        writer.write(place, shared, 1)

    def write_again() -> dict[str, str]:
        write()
        return dict(writer.read(place))

    straight = watch(write, start())
    assert straight.code == 0, f"{name} fails without a kill"
    after, wanted = forked(lambda: dict(writer.read(place)), work), files(place, writer)
    report = Report(name, len(straight.changes))
    points = [(n, False) for n in range(report.changes)]
    points += [(n, True) for n, c in enumerate(straight.changes) if c.split()[0] in TORN]
    if most is None and len(points) > MANY:
        most = SAMPLE
    if most is not None and most < len(points):
        points = sorted(random.Random(f"{seed} {name}").sample(points, most))
    for last, torn in points:
        outcome = watch(write, start(), last=last, torn=torn)
        where = f"{name}, {'within' if torn else 'before'} change {last}"
        where += f" ({' -> '.join(straight.changes[max(0, last - 1) : last + 1])})"
        report.points += 1
        report.torn += torn
        try:
            if outcome.code:
                raise AssertionError("it failed by itself")
            _check_kept(before, forked(lambda: dict(writer.read(place)), work), after)
            again = forked(write_again, work)
            _check_same("the contents read", after, again)
            _check_same("files", wanted, files(place, writer))
        except AssertionError as error:
            report.failures.append(f"{where}: {error}")
    return report


TORN = ("write", "pwrite64")


def files(place: Path, writer: Writer) -> dict[str, str]:
    """Digests of all files, by path; only temporary names where two runs differ in the others."""
    if not writer.same_bytes:
        left = [path for path in place.rglob("*") if "tmp" in path.name]
        return {str(path.relative_to(place)): "" for path in (*place.iterdir(), *left)}
    paths = [path for path in sorted(place.rglob("*")) if path.name != LOCK]  # it holds the PID
    return {str(path.relative_to(place)): _digest(path) for path in paths}


def _digest(path: Path) -> str:
    if path.is_symlink():
        return f"to {os.readlink(path)}"
    return "a folder" if path.is_dir() else hashlib.sha256(path.read_bytes()).hexdigest()


def forked(function: Callable[[], Any], work: Path) -> Any:
    """Run a function in a fork and return its result, by JSON."""
    result = work.parent / f"{work.name}.json"
    result.parent.mkdir(parents=True, exist_ok=True)
    outcome = watch(lambda: result.write_text(json.dumps(function()), "utf-8"), work / "nowhere")
    if outcome.code:
        raise AssertionError("the files cannot be read, or the writer fails")
    return json.loads(result.read_text("utf-8"))


def _check_kept(before: Mapping, have: Mapping, after: Mapping) -> None:
    for name in sorted(before.keys() | have.keys() | after.keys()):
        if have.get(name) not in (before.get(name), after.get(name)):
            raise AssertionError(f"{name} is neither what it was nor what it was to become")


def _check_same(what: str, wanted: Mapping, have: Mapping) -> None:
    differing = [k for k in sorted(wanted.keys() | have.keys()) if wanted.get(k) != have.get(k)]
    if differing:
        raise AssertionError(f"after it ran again, {what} differ: {', '.join(differing)}")
