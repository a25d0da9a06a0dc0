"""One process that fuzzes a target and says on stdout, line by line, what came of each case."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from egosim_jax.io.digest import fingerprint
from egosim_jax.types import InputError
from tests.fuzz.mutations import BYTES
from tests.fuzz.target import Target

MODULES = (
    "targets_media", "targets_data", "targets_recordings", "targets_run", "targets_serving",
    "targets_convert", "targets_expanding",
)  # fmt: skip
"""Modules of the targets; those that import much are last."""
MAX_SECONDS, MAX_BYTES, MAX_MESSAGE = 20, 1 << 30, 4000


def targets() -> Iterator[Target]:
    """Every target; a module is imported when its targets are asked for."""
    for name in MODULES:
        yield from import_module(f"tests.fuzz.{name}").TARGETS


def fuzz(target: Target, *, seed: int, first: int, cases: int) -> None:
    """Run the cases from `first` on; a line when one begins and a line with its outcome."""
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as home:
        sample = Path(home) / "sample"
        sample.mkdir()
        target.make(sample)
        files = sorted({f for glob in target.files for f in sample.glob(glob) if f.is_file()})
        assert files, f"{target.name} has no files"
        want = _result(target.read, sample)
        for number in range(first, cases):
            case = random.Random(f"{target.name} {seed} {number}")
            folder = Path(home) / "case" / sample.name
            shutil.copytree(sample, folder)
            kind = _change(target, files, sample, folder, case)
            _say({"case": number, "kind": kind})
            _say({"case": number, **_outcome(target, folder, want)})
            shutil.rmtree(folder.parent)


def _change(target: Target, files: list[Path], sample: Path, folder: Path, case: Any) -> str:
    """Change one file of a copy; the kind of change."""
    file = folder / case.choice(files).relative_to(sample)
    mutate = case.choice(BYTES + target.mutations * 2)
    data = file.read_bytes()
    changed = mutate(data, case)
    if case.random() < 0.1:
        changed = case.choice(BYTES)(changed, case)
    file.write_bytes(changed)
    return mutate.__name__


def _outcome(target: Target, folder: Path, want: str) -> dict[str, Any]:
    before, then = _peak_reset(), _processor_s()

    def check(*_: Any) -> None:
        if _processor_s() - then > MAX_SECONDS:
            raise _TooSlowError

    signal.signal(signal.SIGALRM, check)
    signal.setitimer(signal.ITIMER_REAL, 1, 1)
    try:
        got = _result(target.read, folder)
    except InputError as error:
        message = str(error)
        bad = "\n" in message or len(message) > MAX_MESSAGE or not message.isprintable()
        found = {"outcome": "unclear message" if bad else "refused", "detail": message[:300]}
    except _TooSlowError:
        found = {"outcome": "slow"}
    except BaseException:
        found = {"outcome": "traceback", "detail": traceback.format_exc()[-1500:]}
    else:
        found = _judge(target, folder, got, want)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    if _processor_s() - then > MAX_SECONDS:
        return {**found, "outcome": "slow"}
    grown = _status("VmHWM") - before + sum(_status("VmHWM", pid) for pid in _children())
    return {**found, "outcome": "memory", "detail": f"{grown:,}"} if grown > MAX_BYTES else found


def _judge(target: Target, folder: Path, got: str, want: str) -> dict[str, Any]:
    if got == want:
        return {"outcome": "equal"}
    if target.sealed:
        return {"outcome": "changed"}
    if target.reference is not None:
        try:
            same = got == _result(target.reference, folder)
        except Exception as error:
            return {"outcome": "changed", "detail": f"the reference refuses: {error!r:.300}"}
        return {"outcome": "as reference" if same else "changed"}
    return {"outcome": "unseen" if target.lossy else "changed"}


def _result(read: Any, folder: Path) -> str:
    return fingerprint(read(folder))


class _TooSlowError(BaseException):
    pass


def _processor_s() -> float:
    """Return the processor time of this process and its children in seconds.

    On a busy machine, other processes add to the time on the clock, but not to this one.
    """
    ticks = 0
    for process in _children():
        fields = _about(process, "stat").rpartition(")")[2].split()
        ticks += sum(map(int, fields[11:13]))
    return sum(os.times()[:4]) + ticks / os.sysconf("SC_CLK_TCK")


def _peak_reset() -> int:
    for process in ("self", *_children()):
        Path(f"/proc/{process}/clear_refs").write_text("5", "ascii")
    return _status("VmRSS")


def _children() -> list[str]:
    """The processes that this one started and that run, such as readers of HDF5."""
    found = []
    for path in Path("/proc/self/task").glob("*/children"):
        with suppress(FileNotFoundError):  # the thread has ended
            found += path.read_text("ascii").split()
    return [pid for pid in found if _status("VmRSS", pid)]


def _status(name: str, process: str = "self") -> int:
    """A size of a process in bytes; 0 if it has ended."""
    lines = _about(process, "status").splitlines()
    values = [int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:")]
    return sum(values)


def _about(process: str, file: str) -> str:
    """Return a file of the kernel about a process; nothing if it has ended."""
    try:
        return Path(f"/proc/{process}/{file}").read_text("ascii", "replace")
    except (FileNotFoundError, ProcessLookupError):
        return ""


def _say(record: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(record) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    name, seed, first, cases = sys.argv[1:]
    target = next(target for target in targets() if target.name == name)
    fuzz(target, seed=int(seed), first=int(first), cases=int(cases))
