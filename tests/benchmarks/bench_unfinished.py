"""Memory of a server with unfinished websocket messages: before, during, after, and again.

    python -m tests.benchmarks.bench_unfinished --clients 200

Each client sends 15 MiB of a message of 16 MiB, and no more.
"""

from __future__ import annotations

import base64
import multiprocessing
import os
import socket
import struct
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from egosim_jax.interactive.server.wire import MAX_BYTES

SENT = MAX_BYTES - (1 << 20)
"""Bytes that a client sends of a message."""


@dataclass
class Options:
    """Options of the measurement."""

    clients: int = 200
    """Number of clients."""
    rounds: int = 3
    """Number of times that all clients connect and leave."""


def _serve(folder: str, pipe: Any) -> None:
    from tests.unit.interactive.server.served import run

    pipe.send(run(Path(folder))[1])
    pipe.recv()


def _resident_mib(pid: int) -> int:
    lines = Path(f"/proc/{pid}/status").read_text("ascii").splitlines()
    return next(int(line.split()[1]) >> 10 for line in lines if line.startswith("VmRSS"))


def _unfinished(port: int, chunk: bytes) -> socket.socket:
    """Return a websocket that has sent most of a message, as far as the server reads it."""
    client = socket.create_connection(("127.0.0.1", port), timeout=10)
    key = base64.b64encode(os.urandom(16)).decode()
    client.sendall(
        f"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    client.recv(1 << 16)
    with suppress(OSError):  # refused by the server
        client.sendall(struct.pack("!BBQ4x", 0x82, 0x80 | 127, MAX_BYTES))
        for _ in range(SENT // len(chunk)):
            client.sendall(chunk)
    return client


def main(options: Options) -> None:
    """Print the resident memory of the server."""
    ours, theirs = multiprocessing.Pipe()
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        server = context.Process(target=_serve, args=(folder, theirs), daemon=True)
        server.start()
        port, pid = ours.recv(), server.pid or 0
        print(f"before: {_resident_mib(pid):,} MiB")
        for number in range(1, options.rounds + 1):
            clients = [_unfinished(port, bytes(1 << 20)) for _ in range(options.clients)]
            time.sleep(1)
            print(f"round {number}, {options.clients} clients: {_resident_mib(pid):,} MiB")
            for client in clients:
                client.close()
            time.sleep(3)
            print(f"round {number}, closed: {_resident_mib(pid):,} MiB")
        server.kill()


if __name__ == "__main__":
    main(tyro.cli(Options))
