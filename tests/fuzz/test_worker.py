"""The time limit of a fuzzed case counts the processor's time, of children too."""

import subprocess
import sys
import time

import pytest

from tests.fuzz import worker
from tests.fuzz.target import Target

BUSY = "import time\nwhile time.process_time() < {}: pass"


def run_child(seconds):
    subprocess.run([sys.executable, "-S", "-c", BUSY.format(seconds)], check=True)


def run_open_child(seconds):
    """Spend the time in a child that still runs at the end, as the readers' does."""
    code = BUSY.format(seconds) + "\nprint(flush=True); input()"
    pipe = subprocess.PIPE
    process = subprocess.Popen([sys.executable, "-S", "-c", code], stdin=pipe, stdout=pipe)
    CHILDREN.append(process)
    assert process.stdout is not None
    assert process.stdout.readline()


def run_here(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


CHILDREN = []


@pytest.fixture
def _children():
    yield
    while CHILDREN:
        CHILDREN.pop().communicate(b"\n")


@pytest.mark.usefixtures("_children")
@pytest.mark.parametrize(
    ("work", "seconds", "outcome"),
    [
        (time.sleep, 0.5, "equal"),
        (run_here, 0.4, "slow"),
        (run_here, 3, "slow"),  # interrupted
        (run_child, 0.4, "slow"),
        (run_open_child, 0.4, "slow"),
    ],
)
def test_a_case_is_slow_by_its_processor_time(work, seconds, outcome, tmp_path, monkeypatch):
    monkeypatch.setattr(worker, "MAX_SECONDS", 0.3)
    target = Target(name="x", make=print, read=lambda _: work(seconds), files=())
    begun = time.process_time()
    found = worker._outcome(target, tmp_path, worker.fingerprint(None))
    assert found["outcome"] == outcome
    assert time.process_time() - begun < 2
