"""Position of an online training, which its checkpoints keep."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(kw_only=True)
class Progress:
    """Counters of an online training, kept over interruptions."""

    seconds: float = 0.0
    """Seconds that the run had taken when this was last saved."""
    first: float | None = None
    """Second of the first update."""
    done: int = 0
    """Finished updates of the denoiser."""
    decoded: int = 0
    """Finished updates of the decoder."""
    decoder_first: float | None = None
    """Share of the run at the decoder's first update."""
    pace: int | None = None
    """Updates of the decoder next to one program of the denoiser's."""
    arrived: int = 0
    """Clips that the processes have made, so that they continue with other scenes."""

    def get_state(self) -> Mapping[str, Any]:
        """Return the counters as JSON."""
        return asdict(self)

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Set the counters to saved ones."""
        for name, value in state.items():
            setattr(self, name, value)
