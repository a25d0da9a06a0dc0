"""Server in this process, reached over its sockets."""

import json
import threading
import urllib.error
import urllib.request

from egosim_jax.interactive.server.server import bind, serve
from egosim_jax.interactive.server.service import Service
from egosim_jax.interactive.server.store import Limits, Store
from tests.painted import painted

TOKEN = "secret"  # noqa: S105


def run(folder, token=None, limits=None, world=None):
    """A service, its port, and the thread that serves it."""
    store = Store(folder, world or painted(), limits or Limits())
    service = Service(store, world="painted")
    ports, ready = [], threading.Event()

    def note(port):
        ports.append(port)
        ready.set()

    args, options = (service, bind("127.0.0.1", 0, token=token)), {"token": token, "ready": note}
    thread = threading.Thread(target=serve, args=args, kwargs=options, daemon=True)
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
