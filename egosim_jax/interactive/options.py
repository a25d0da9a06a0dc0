"""Options of commands that serve worlds, without heavy imports."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from egosim_jax.types import InputError, check_counts


@dataclass(frozen=True, kw_only=True)
class ClipOptions:
    """Model, sampling and perception of the clips."""

    config: str | None = None
    """Name of the model, or preview, which needs no weights.

    By default tabletop, or tabletop_student of `egosim play`. Scenes that are not of the tabletop
    world then get previews."""
    weights: Path | None = None
    """Folder of weights; by default the shipped or fetched ones."""
    perception: str = "classical"
    """Perception pipeline, with its options (`egosim simulate --help`)."""
    update_every: Literal["clip", "chunk"] = "clip"
    """Update the state after each clip or, with a causal student, after each chunk of a clip."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless the number of steps is positive."""
        check_counts({"--steps": self.steps})


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a server."""

    sessions: int = 64
    """Maximum number of open sessions."""
    queue: int = 32
    """Maximum number of waiting and running requests; further ones get status 429."""
    threads: int = 8
    """Maximum number of concurrent steps."""
    max_steps: int = 10_000
    """Maximum number of steps in a session."""
    saved: int = 100
    """Maximum number of saved moments of a session."""
    kept: int = 1000
    """Maximum number of sessions that are closed and kept on disk."""
    open_steps: int = 8
    """Maximum number of steps that clients give in parts; each occupies memory of the device."""
    connections: int = 256
    """Maximum number of client connections; further ones get status 503."""
    step_timeout: float = 120.0
    """Maximum time in seconds that a client waits for a step; the step itself continues."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless all limits are positive."""
        counts = {name: n for name, n in asdict(self).items() if name != "step_timeout"}
        check_counts({f"--{name.replace('_', '-')}": n for name, n in counts.items()})
        if not self.step_timeout > 0:
            raise InputError(
                f"The timeout is {self.step_timeout} s: it must be positive. (--step-timeout)"
            )

    def to_json(self) -> dict[str, Any]:
        """Return the limits by the names that clients know."""
        names = {"max_steps": "steps", "step_timeout": "step_timeout_s"}
        return {names.get(name, name): value for name, value in asdict(self).items()}
