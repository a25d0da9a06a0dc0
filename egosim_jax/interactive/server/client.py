"""Websocket client of a session server. Needs no jax.

with Client("ws://127.0.0.1:8000") as client:
    session = client.create(seed=3)
    reply = session.step(rows)  # {"frames": ..., "row": ..., "info": ...}
    reply = session.step(rows, show=lambda frames: ...)  # groups of decoded frames
    reply = session.step_part(rows)  # frames of the next part: change course while a clip is made
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import UInt8

from egosim_jax.interactive.server import wire
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.types import InputError

Show = Callable[[UInt8[np.ndarray, "g h w 3"]], None]
"""Callback for each decoded group of frames."""
REPEATABLE = ("step", "reset", "save", "load", "status")
"""Idempotent requests, which may be sent again after a timeout."""


class Client:
    """Connection to a server; use one per thread."""

    def __init__(
        self,
        address: str,
        *,
        token: str | None = None,
        timeout_s: float = 600.0,
        patience_s: float = 600.0,
        wait: float = 0.0,
    ):
        """Connect to an address such as ws://127.0.0.1:8000.

        A server that has not started yet is tried again for up to `wait` seconds. A request waits
        `timeout_s` for its reply. While the server is full or the session busy, it is sent again
        for up to `patience_s`.
        """
        self._timeout_s, self._patience_s = timeout_s, patience_s
        headers = {"Authorization": f"Bearer {token}"} if token else None
        self._connection = connect(address, headers, wait_s=wait)
        self._socket = self._connection.__enter__()
        self.server: dict[str, Any] = wire.unpack(self._received())
        """Description of the server: world, size and rate of its clips, limits."""

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; the sessions stay open."""
        self._connection.__exit__(None, None, None)

    def _received(self) -> bytes:
        reply = self._socket.recv(timeout=self._timeout_s)
        if isinstance(reply, bytes):
            return reply
        error = json.loads(reply)
        raise RequestError(
            error["status"],
            error["code"],
            error["message"],
            retry_after_s=error.get("retry_after_s"),
        )

    def request(self, kind: str, /, *, show: Show | None = None, **fields: Any) -> dict[str, Any]:
        """Return the reply to a request. Raises `RequestError` with the server's message.

        `show` gets the frames of a streamed step before its reply. An interrupt or timeout closes
        the connection: connect and attach again.
        """
        message = wire.pack({"request": kind, **fields})
        until = time.monotonic() + self._patience_s
        while True:
            try:
                return self._ask(message, show)
            except RequestError as error:
                wait = error.retry_after_s
                late = error.code in ("timeout", "part_restarts") and kind in REPEATABLE
                again = error.status in (409, 429) or late
                if wait is None or not again or time.monotonic() + wait > until:
                    raise
            time.sleep(wait)

    def _ask(self, message: bytes, show: Show | None) -> dict[str, Any]:
        try:
            self._socket.send(message)
            reply = wire.unpack(self._received())
            while show is not None and "first_frame" in reply:
                show(reply["frames"])
                reply = wire.unpack(self._received())
        except RequestError:
            raise
        except BaseException:  # otherwise a late reply would be read as the next request's
            self.close()
            raise
        return reply

    def create(self, **fields: Any) -> RemoteSession:
        """Create a session from a `seed` or an `episode`."""
        return RemoteSession(self, self.request("create", **fields))

    def attach(self, session: str) -> RemoteSession:
        """Continue a session of any client, by its id."""
        status = self.request("status", session=session)
        return RemoteSession(self, {**status, "step_id": status["committed_step_id"]})


def connect(address: str, headers: Mapping[str, str] | None, *, wait_s: float) -> Any:
    """Return the connection to a server, which may start meanwhile."""
    import websockets.sync.client

    until, announced = time.monotonic() + wait_s, False
    while True:
        try:
            return websockets.sync.client.connect(
                address.replace("http", "ws", 1) if address.startswith("http") else address,
                compression=None,
                max_size=None,
                additional_headers=headers,
                ping_timeout=None,
            )
        except ConnectionRefusedError:  # nothing listens at the address yet
            if time.monotonic() >= until:
                raise
        if not announced:
            announced = True
            print(f"waits up to {wait_s:g} s for {address} to start", file=sys.stderr, flush=True)
        time.sleep(min(0.5, max(0.0, until - time.monotonic())))


class RemoteSession:
    """Session on a server."""

    def __init__(self, client: Client, reply: dict[str, Any]):
        self._client, self.id = client, reply["session"]
        self.reply = reply
        """Reply to the request that created or attached the session."""
        self.step_id: int = reply["step_id"]
        """Number of the last committed step."""
        self._part = 0

    def step(self, rows: np.ndarray, *, show: Show | None = None, **fields: Any) -> dict[str, Any]:
        """Make the next step, and return its reply.

        `show` gets the frames in groups as they are decoded, before the step is perceived and
        committed. A step that is already committed or under way is not shown.
        """
        reply = self._step(rows, show, fields)
        self.step_id = reply["step_id"]
        return reply

    def step_part(
        self, rows: np.ndarray, *, show: Show | None = None, **fields: Any
    ) -> dict[str, Any]:
        """Make the next part of the next step, and return its reply.

        The server's description has the number of rows of each part (`part_rows`). The reply to the
        last part is the step's. After an error the next call begins the step again.
        """
        part, self._part = self._part + 1, 0
        reply = self._step(rows, show, {"part": part, **fields})
        if "part" in reply:
            self._part = part
        else:
            self.step_id = reply["step_id"]
        return reply

    def _step(self, rows: np.ndarray, show: Show | None, fields: dict[str, Any]) -> dict[str, Any]:
        fields = {"actions": np.asarray(rows, float), **fields}
        if show is not None:
            fields["stream"] = True
        reply = self._client.request(
            "step", show=show, session=self.id, step_id=self.step_id + 1, **fields
        )
        if (reply["session"], reply["step_id"]) != (self.id, self.step_id + 1):
            raise InputError(
                f"The reply is step {reply['step_id']} of session {reply['session']}, not step "
                f"{self.step_id + 1} of {self.id}: a client is for one thread. Use a client "
                "per thread."
            )
        return reply

    def reset(self, **fields: Any) -> dict[str, Any]:
        """Continue from a `seed` or an `episode`, by default from the first start."""
        return self._client.request("reset", session=self.id, **fields)

    def save(self, name: str) -> None:
        """Save the current position of the session under a name."""
        self._client.request("save", session=self.id, name=name)

    def load(self, name: str) -> dict[str, Any]:
        """Continue from a saved position."""
        return self._client.request("load", session=self.id, name=name)

    def status(self) -> dict[str, Any]:
        """Return the committed step, the hash of the state and the saved names."""
        return self._client.request("status", session=self.id)

    def close(self, *, keep: bool = False) -> None:
        """End the session and remove its files on the server, unless `keep` is set."""
        self._client.request("close", session=self.id, keep=keep)
