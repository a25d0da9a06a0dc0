"""A private cache that several processes write."""

import os
from contextlib import contextmanager

from egosim_jax.io.private import PrivateCache


def test_a_file_that_another_process_removes_while_old_ones_are_listed_costs_nothing(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache = PrivateCache.open("some", most=1)
    assert cache is not None
    cache.put("first", b"1")
    scandir = os.scandir

    @contextmanager
    def raced(folder):
        with scandir(folder) as entries:
            listed = list(entries)
        if "second" in {entry.name for entry in listed}:
            (cache.folder / "first").unlink()
        yield listed

    monkeypatch.setattr("egosim_jax.io.private.os.scandir", raced)
    cache.put("second", b"2")  # a warning would be an error here
    monkeypatch.undo()
    assert cache.get("second") == b"2"
    assert not (cache.folder / "first").exists()
