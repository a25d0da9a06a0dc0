"""`egosim train tabletop --online`: train while other processes make scenes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from egosim_jax.runtime import command
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


def main(
    args: Sequence[str] | None = None, *, program: str = "python -m egosim_jax.train.online"
) -> int:
    """Parse the command line and train."""
    return command.main(
        Online,
        program=program,
        description="Train while other processes make scenes. The same command resumes an "
        "interrupted run.",
        args=args,
    )


if __name__ == "__main__":
    sys.exit(main())
