"""`egosim serve`: sessions of a world for policies on this machine or others."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.types import InputError, check_counts

if TYPE_CHECKING:
    from egosim_jax.interactive.server.service import Service

TOKEN = "EGOSIM_TOKEN"  # noqa: S105 - the name of the variable that has it
NEEDS = ("fastapi", "uvicorn", "websockets", "msgpack", "prometheus_client")


@dataclass(frozen=True, kw_only=True)
class Serve:
    """Serve sessions of a world over websocket and HTTP, for policies to step.

    openpi-client connects to it; docs/serving.md has the requests. Sessions are kept in OUT: after
    a crash the same command resumes all of them. SIGTERM finishes the steps under way first. Needs
    the extra `serve`. Prints the address when it takes requests.
    """

    help_groups: ClassVar[HelpGroups] = {
        "clips": ("perception", "steps", "batch"),
        "limits": ("sessions", "queue", "threads", "max_steps", "connections", "step_timeout"),
    }
    out: Path = Path("runs/serve")
    """Folder of the sessions."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights, by default those that ship with the package or were fetched."""
    world: Literal["generated", "true"] = "generated"
    """World of the sessions: the model's, or the tabletop world itself."""
    perception: str = "classical"
    """Perception pipeline by name, with its options."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""
    batch: int = 4
    """Most clips that are generated together.

    1 turns batching off: then a clip is equal to the byte whatever other sessions do."""
    host: str = "127.0.0.1"
    """Address to listen on; another than the loopback's needs a token in EGOSIM_TOKEN."""
    port: int = 8000
    """Port to listen on; 0 for a free one."""
    sessions: int = 64
    """Most open sessions."""
    queue: int = 32
    """Most requests that wait or run; further ones are refused with status 429."""
    threads: int = 8
    """Most steps that run at the same time."""
    max_steps: int = 10_000
    """Most steps of a session."""
    connections: int = 256
    """Most connections of clients; further ones are refused with status 503."""
    step_timeout: float = 120.0
    """Longest time in seconds that a client waits for a step, which continues without it."""

    def run(self) -> int:
        """Check, load, compile, resume all sessions, serve."""
        missing = [name for name in NEEDS if find_spec(name) is None]
        if missing:
            raise InputError(
                f"egosim serve needs {', '.join(missing)}, which is not installed: pip install "
                "'egosim-jax[serve]'."
            )
        check_counts({"--batch": self.batch, "--steps": self.steps, "--threads": self.threads})
        if not 0 <= self.port < 1 << 16:
            raise InputError(f"--port must be from 0 to 65535, not {self.port}.")
        from egosim_jax.interactive.server.server import bind, serve

        token = os.environ.get(TOKEN, "").strip() or None
        with bind(self.host, self.port, token=token) as bound:
            service = self._service()
            finished = True
            try:
                finished = serve(service, bound, token=token, ready=self._ready)
            finally:
                service.store.close(at_once=not finished)
        return ExitCode.DONE

    def _service(self) -> Service:
        from egosim_jax.interactive.server.service import open_service
        from egosim_jax.interactive.server.store import Limits

        limits = Limits(
            sessions=self.sessions,
            queue=self.queue,
            threads=self.threads,
            steps=self.max_steps,
            connections=self.connections,
            step_timeout_s=self.step_timeout,
        )
        return open_service(
            self.out,
            limits,
            world=self.world,
            config=self.config,
            weights=self.weights,
            perception=self.perception,
            steps=self.steps,
            batch=self.batch,
        )

    def _ready(self, port: int) -> None:
        print(f"http://{self.host}:{port}", flush=True)
