"""A disk that takes no more data: every request names it, nothing changes, and /readyz fails."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.interactive.server import store as store_module
from egosim_jax.interactive.server.errors import RequestError, as_request_error
from egosim_jax.interactive.server.session import Session
from egosim_jax.io import atomic
from tests.unit.interactive.server.served import http, run


def fill(monkeypatch, after, code=errno.ENOSPC):
    """Let a number of files reach the disk, and none afterwards."""
    real, count = atomic.sync, iter(range(after))

    def sync(path: Path) -> None:
        if next(count, None) is None:
            raise OSError(code, os.strerror(code), str(path))
        real(path)

    monkeypatch.setattr(atomic, "sync", sync)


def files(folder):
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != ".lock"}


def ask(store, session, name):
    row = session.actions.rest[None]
    requests = {
        "step": lambda: store.step({"session": session.id, "step_id": 2, "actions": row}),
        "save": lambda: store.save({"session": session.id, "name": "new"}),
        "save again": lambda: store.save({"session": session.id, "name": "old"}),
        "reset": lambda: store.reset({"session": session.id, "seed": 4}),
        "load": lambda: store.load({"session": session.id, "name": "old"}),
    }
    return requests[name]().result()


WRITES = [("step", 0), ("step", 2), ("step", 4), ("save again", 0), ("reset", 2), ("load", 0)]


@pytest.mark.parametrize(("name", "after"), WRITES)
def test_a_full_disk_changes_no_session(store, monkeypatch, name, after):
    session = store.create({"seed": 3})
    row = session.actions.rest[None]
    store.step({"session": session.id, "step_id": 1, "actions": row}).result()
    store.save({"session": session.id, "name": "old"}).result()
    before, kept = session.result, files(session.folder / "saved")
    with monkeypatch.context() as patched:
        fill(patched, after)
        with pytest.raises(RequestError, match="No space left on device on the disk of") as refused:
            ask(store, session, name)
        assert (refused.value.status, refused.value.code) == (507, "storage")
        assert str(store.folder) not in str(refused.value)
        assert store.storage_problem() == "No space left on device"
    assert session.result is before
    found = Session(session.folder, store.backend)
    assert (found.committed, found.result.info) == (1, before.info)
    assert not found.pending
    saved = files(session.folder / "saved")
    assert {path: saved.get(path) for path in kept} == kept
    assert store.storage_problem() == ""
    ask(store, session, name)  # the advice: send it again


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
def test_readyz_follows_the_disk(tmp_path, monkeypatch, code):
    service, port, _ = run(tmp_path / "sessions")
    http(port, "/sessions", {"session": "a"})
    row = np.asarray(service.store.get("a").actions.rest).tolist()
    request = {"step_id": 1, "actions": [row], "observe": []}
    assert http(port, "/readyz")[0] == 200
    with monkeypatch.context() as patched:
        fill(patched, 0, code)
        status, body = http(port, "/sessions/a/step", request)
        assert status == 507
        assert os.strerror(code).encode() in body
        assert http(port, "/readyz") == (503, f"{os.strerror(code)}\n".encode())
    assert http(port, "/readyz")[0] == 200
    assert http(port, "/sessions/a/step", request)[0] == 200
    service.store.close()


def test_a_nearly_full_disk_is_not_ready(store, monkeypatch):
    monkeypatch.setattr(store_module, "MIN_FREE_BYTES", 1 << 62)
    assert store.storage_problem() == "No space left on device"


def test_a_server_whose_folder_is_gone_is_not_ready(store):
    store.folder.rename(store.folder.with_name("moved"))
    assert store.storage_problem() == "No such file or directory"
    store.folder.with_name("moved").rename(store.folder)
    assert not store.storage_problem()


def test_a_library_that_names_only_the_reason_is_understood():
    error = RuntimeError("write failed: No space left on device")
    assert as_request_error(error).code == "storage"
    assert as_request_error(RuntimeError("anything else")).code == "internal"
