"""Damaged files of every format are refused, or read as they were, within time and memory.

    FUZZ_CASES=1500 pytest tests/fuzz -k "mp4 or png"

damages 1500 files of two formats instead of ten files of each.
"""

import os
import random
import shutil
import signal
import time
import traceback
import warnings
from importlib import import_module
from pathlib import Path

import pytest

from egosim_jax.io.digest import fingerprint
from egosim_jax.types import InputError
from tests.fuzz.mutations import BYTES
from tests.fuzz.outside import was_opened

MODULES = (
    "media", "data", "recordings", "run", "serving", "convert", "expanding", "robots", "sessions",
)  # fmt: skip
TARGETS = [t for name in MODULES for t in import_module(f"tests.fuzz.targets_{name}").TARGETS]
CASES = int(os.environ.get("FUZZ_CASES", "10"))
MAX_SECONDS, MAX_BYTES, MAX_MESSAGE = 20, 1 << 30, 4000


class TooSlowError(BaseException):
    """Raised after `MAX_SECONDS` of this thread's time; readers do not catch it."""


def stop_after(limit_s):
    """Return a handler that raises as soon as this thread has run for `limit_s` seconds.

    Timers count the whole process: threads of other tests, such as XLA's, ring them too early.
    """

    def stop(*_):
        rest = limit_s - time.thread_time()
        if rest <= 0:
            raise TooSlowError
        signal.setitimer(signal.ITIMER_PROF, max(rest, 0.1))

    return stop


def change(target, sample, folder, case):
    """Change one file of a copy, or its folder; return the kind of change."""
    moves, kinds = target.rearrangements * 2, BYTES + target.mutations * 2
    if moves and case.random() < len(moves) / (len(moves) + len(kinds)):
        rearrange = case.choice(moves)
        rearrange(folder, case)
        return rearrange.__name__
    files = sorted({f for glob in target.files for f in sample.glob(glob) if f.is_file()})
    file = folder / case.choice(files).relative_to(sample)
    mutate = case.choice(kinds)
    changed = mutate(file.read_bytes(), case)
    file.write_bytes(case.choice(BYTES)(changed, case) if case.random() < 0.1 else changed)
    return mutate.__name__


def judge(target, folder, want):
    """Read a changed sample; return the failure, or an empty text."""
    limit_s = time.thread_time() + MAX_SECONDS
    signal.signal(signal.SIGPROF, stop_after(limit_s))
    signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)
    try:
        try:
            value = target.read(folder)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        if time.thread_time() > limit_s:
            return "slow"
        got = fingerprint(value)
    except InputError as error:
        message = str(error)
        clear = len(message) <= MAX_MESSAGE and message.isprintable()
        return "" if clear else f"unclear message: {message[:300]!r}"
    except TooSlowError:
        return "slow"
    except BaseException:
        return traceback.format_exc()[-1500:]
    if got == want or (target.lossy and not target.sealed):
        return ""
    try:
        same = target.reference is not None and got == fingerprint(target.reference(folder))
    except Exception as error:
        return f"read, but the reference refuses it: {error!r:.300}"
    return "" if same else "read with another result"


def peak_bytes():
    """Return the most memory that this process had since `clear_refs`."""
    lines = Path("/proc/self/status").read_text("ascii").splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_a_damaged_file_is_refused_or_read_as_it_was(target, tmp_path):
    sample, folder = tmp_path / "sample", tmp_path / "case" / "sample"
    sample.mkdir()
    target.make(sample)
    before = signal.getsignal(signal.SIGPROF)
    failures = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        want = fingerprint(target.read(sample))
        for number in range(CASES):
            case = random.Random(f"{target.name} {number}")
            shutil.copytree(sample, folder)
            kind = change(target, sample, folder, case)
            Path("/proc/self/clear_refs").write_text("5", "ascii")
            was_opened()
            had = peak_bytes()
            problem = judge(target, folder, want)
            if peak_bytes() - had > MAX_BYTES:
                problem = f"{peak_bytes() - had:,} bytes of memory"
            if was_opened():
                problem = f"a file outside was opened; {problem}"
            if problem:
                failures.append(f"case {number}, {kind}: {problem}")
            shutil.rmtree(folder.parent)
    signal.signal(signal.SIGPROF, before)
    assert not failures, "\n".join(failures)
