"""Limits of a server."""

from __future__ import annotations

from dataclasses import dataclass

from egosim_jax.types import InputError, check_counts


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a server."""

    sessions: int = 64
    """Maximum number of open sessions."""
    queue: int = 32
    """Maximum number of waiting and running requests."""
    threads: int = 8
    """Maximum number of concurrent steps."""
    steps: int = 10_000
    """Maximum number of steps of a session."""
    saved: int = 100
    """Maximum number of saved starts of a session."""
    kept: int = 1000
    """Maximum number of sessions that are closed and kept."""
    open_steps: int = 8
    """Maximum number of steps that are given in parts; each one occupies memory of the device."""
    connections: int = 256
    """Maximum number of client connections."""
    step_timeout_s: float = 120.0
    """Maximum time that a request waits for its step; the step then continues without it."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless all limits are positive."""
        check_counts({"queue": self.queue, "threads": self.threads, "sessions": self.sessions})
        check_counts({"steps of a session": self.steps, "saved starts": self.saved})
        check_counts({"connections": self.connections, "kept sessions": self.kept})
        check_counts({"open steps": self.open_steps})
        if not self.step_timeout_s > 0:
            raise InputError(f"The timeout is {self.step_timeout_s} s: it must be positive.")
