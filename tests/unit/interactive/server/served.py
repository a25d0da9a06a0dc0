"""Server in this process, reached over its sockets, and steps of its sessions."""

import json
import threading
import urllib.error
import urllib.request

import numpy as np

from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.origins import bind
from egosim_jax.interactive.server.server import serve
from egosim_jax.interactive.server.service import Service
from egosim_jax.interactive.server.store import Store
from tests.painted import painted

TOKEN = "secret"  # noqa: S105


def run(folder, token=None, limits=None, world=None, bound=None):
    """A service, its port, and the thread that serves it."""
    store = Store(folder, world or painted(), limits or Limits())
    service = Service(store, world="painted")
    ports, ready = [], threading.Event()

    def note(port):
        ports.append(port)
        ready.set()

    bound = bound or bind("127.0.0.1", 0, token=token)
    options = {"token": token, "ready": note}
    thread = threading.Thread(target=serve, args=(service, bound), kwargs=options, daemon=True)
    thread.start()
    assert ready.wait(30)
    return service, ports[0], thread


def http(port, path, fields=None, method=None, **headers):
    data = None if fields is None else json.dumps(fields).encode()
    headers = {"Content-Type": "application/json", **headers}
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}{path}", data=data, headers=headers, method=method
    )
    try:
        with urllib.request.urlopen(request, timeout=60) as reply:  # noqa: S310 - of this machine
            return reply.status, reply.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def rows(session, step=1):
    return session.actions.rest + step * 0.02 * np.eye(7)[1][None]


def step(store, session, number, actions=None):
    actions = rows(session, number) if actions is None else actions
    request = {"session": session.id, "step_id": number, "actions": actions}
    return store.step(request).result()
