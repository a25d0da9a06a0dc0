"""`egosim train tabletop --online`: train while other processes make scenes."""

from __future__ import annotations

from dataclasses import dataclass

from egosim_jax.runtime.command import ExitCode
from egosim_jax.train.online.plan import OnlineTraining


@dataclass(frozen=True, kw_only=True)
class Online(OnlineTraining):
    """Train tabletop's denoiser, encoders and decoder further while other processes make scenes."""

    def run(self) -> int:
        """Train until the end."""
        from egosim_jax.train.online.run import OnlineRun

        OnlineRun(self).train()
        return ExitCode.DONE
