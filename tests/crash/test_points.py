"""One of the points at which every writer is killed; `python -m tests.crash` tries all."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.crash import points

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not points.AVAILABLE, reason="it knows the calls of x86-64 Linux alone"),
]
ROOT = Path(__file__).parents[2]
WRITERS = (
    "snapshot points portrait sheet video journal results config weights to-torch quantize lora "
    "merge pack overwrite encode make executables checkpoint"
)


def test_nothing_is_lost_wherever_a_writer_is_killed(tmp_path):
    few = ["--most", "1", "--seed", "1", "--folder", str(tmp_path)]
    ran = subprocess.run(
        [sys.executable, "-m", "tests.crash", *few, "--writer", *WRITERS.split()],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert ran.stdout.splitlines()[-1] == f"{len(WRITERS.split())} points in all"


def test_calls_from_c_are_seen_in_order_and_not_made_once_it_is_killed(tmp_path):
    program = f"""
import ctypes, os
from pathlib import Path
from tests.crash.points import watch
libc, root = ctypes.CDLL(None), Path({str(tmp_path)!r})
libc.fopen.restype = ctypes.c_void_p

def write():
    file = ctypes.c_void_p(libc.fopen(bytes(root / "a"), b"w"))
    libc.fputs(b"abcdef", file)
    libc.fclose(file)
    os.rename(root / "a", root / "b")

print(watch(write, root).changes, [path.name for path in root.iterdir()])
(root / "b").unlink()
print(watch(write, root, last=1, torn=True).killed, (root / "a").read_bytes())
"""
    ran = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert ran.stdout.splitlines() == [
        "['openat a', 'write a', 'rename a b'] ['b']",
        "True b'abc'",
    ]
