"""Prometheus metrics of a server."""

from __future__ import annotations

import traceback

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from egosim_jax.interactive.server.errors import RequestError, as_request_error

SECONDS = (0.05, 0.1, 0.25, 0.5, 1, 2, 4, 8, 16, 32, 64, 128)
"""Upper bounds of the histogram buckets, in seconds."""


class Metrics:
    """Metrics of one server, in a separate registry: a process may hold several servers."""

    def __init__(self) -> None:
        self.registry = registry = CollectorRegistry()
        self.sessions = Gauge("egosim_sessions", "Open sessions.", registry=registry)
        self.queued = Gauge("egosim_queue", "Waiting or running requests.", registry=registry)
        self.connections = Gauge("egosim_connections", "Open websockets.", registry=registry)
        self.steps = Counter("egosim_steps", "Steps with a sent result.", registry=registry)
        self.refused = Counter("egosim_refused", "Refused requests.", ["code"], registry=registry)
        self.first_frames = Histogram(
            "egosim_first_frames_seconds",
            "Seconds from the request of a streamed step until its first frames are sent.",
            buckets=SECONDS,
            registry=registry,
        )
        self.seconds = Histogram(
            "egosim_request_seconds",
            "Seconds of a request in its thread.",
            buckets=SECONDS,
            registry=registry,
        )

    def refuse(self, error: Exception) -> RequestError:
        """Count an error and convert it for the client; log an internal one."""
        refusal = as_request_error(error)
        if refusal is not error and refusal.code == "internal":
            traceback.print_exception(error)
        self.refused.labels(refusal.code).inc()
        return refusal

    def text(self) -> bytes:
        """Return the metrics in Prometheus's text format."""
        return generate_latest(self.registry)
