"""Worker processes: warm reuse, refusals, failures, deaths and shutdown."""

import os
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.perception.networks.worker import NetworkError, Worker, close_workers, worker_of
from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError

PROGRAM = """
import os, sys, time
from egosim_jax.types import InputError

def load(factor):
    if factor == 0:
        raise InputError("factor must not be 0")
    print("noise of a library")
    calls = 0

    def run(arrays, options):
        nonlocal calls
        calls += 1
        if options.get("sleep"):
            time.sleep(options["sleep"])
        if options.get("refuse"):
            raise InputError("no such clip")
        if options.get("fail"):
            raise ZeroDivisionError("nothing to divide")
        if options.get("die"):
            print("last words", file=sys.stderr, flush=True)
            os.kill(os.getpid(), 9)
        return {"x": factor * arrays["x"]}, {"calls": calls, "pid": os.getpid()}

    return run
"""


@pytest.fixture
def worker(tmp_path, monkeypatch):
    (tmp_path / "doubling.py").write_text(PROGRAM)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    worker = Worker("doubling", {"factor": 2})
    yield worker
    worker.close()


def ask(worker, *, timeout_s=60.0, **options):
    return worker({"x": np.arange(3)}, options, timeout_s=timeout_s)


def is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_worker_stays_warm_and_survives_what_it_refuses(worker):
    arrays, first = ask(worker)
    assert arrays["x"].tolist() == [0, 2, 4]
    with pytest.raises(InputError, match="no such clip"):
        ask(worker, refuse=True)
    _, third = ask(worker)
    assert (first["calls"], third["calls"]) == (1, 3)
    assert first["pid"] == third["pid"] != os.getpid()
    worker.close()
    assert not is_alive(first["pid"])


def test_a_dead_worker_reports_its_last_output_and_the_next_call_starts_another(worker):
    with pytest.raises(NetworkError, match=r"(?s)SIGKILL.*last words") as error:
        ask(worker, die=True)
    assert error.value.code == ExitCode.FAILED
    assert ask(worker)[1]["calls"] == 1


def test_a_failing_network_is_named_with_its_error(worker):
    with pytest.raises(NetworkError, match=r"doubling failed .* ZeroDivisionError: nothing to"):
        ask(worker, fail=True)


def test_a_slow_worker_is_ended(worker):
    pid = ask(worker)[1]["pid"]
    with pytest.raises(NetworkError, match=r"did not finish in 0.2 s.*--timeout-s"):
        ask(worker, sleep=30, timeout_s=0.2)
    assert not is_alive(pid)


def test_a_refusal_while_loading_is_the_users_mistake(worker):
    with pytest.raises(InputError, match="factor must not be 0"):
        ask(Worker("doubling", {"factor": 0}))


def test_equal_settings_share_a_worker():
    assert worker_of("m", {"a": 1, "b": 2}) is worker_of("m", {"b": 2, "a": 1})
    assert worker_of("m", {"a": 1}) is not worker_of("m", {"a": 2})
    close_workers()
