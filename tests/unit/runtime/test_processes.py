"""Calls in worker processes."""

import os

from egosim_jax.runtime.processes import THREADS, run_in_processes


def test_workers_have_one_thread_and_the_parent_keeps_its_own(monkeypatch):
    monkeypatch.delenv(THREADS, raising=False)
    found = dict(run_in_processes(os.getenv, [(THREADS,), ("EGOSIM_UNSET", "none")], workers=2))
    assert found == {0: "1", 1: "none"}
    assert THREADS not in os.environ
