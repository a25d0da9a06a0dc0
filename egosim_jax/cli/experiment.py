"""`egosim experiment`: run a documented experiment by one command that resumes."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Annotated

import tyro

from egosim_jax.experiments.config import (
    DWM,
    Continuous,
    Debug,
    Embodiment,
    LookAway,
    Policies,
    Rank,
    RealTiny,
    Students,
    Tabletop,
    Update,
)
from egosim_jax.runtime.command import ExitCode

MODULES = {
    Tabletop: "tabletop",
    Continuous: "continuous",
    Students: "students",
    Update: "update",
    Embodiment: "embodiment",
    LookAway: "look_away",
    Policies: "policies",
    DWM: "dwm",
    Rank: "rank",
    RealTiny: "real_tiny",
    Debug: "debug",
}
"""Config -> module of `egosim_jax.experiments`, which is also its name on the command line."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Repeat a documented experiment, from training to its table, by one command."""

    command: (
        Annotated[Tabletop, tyro.conf.subcommand("tabletop")]
        | Annotated[Continuous, tyro.conf.subcommand("continuous")]
        | Annotated[Students, tyro.conf.subcommand("students")]
        | Annotated[Update, tyro.conf.subcommand("update")]
        | Annotated[Embodiment, tyro.conf.subcommand("embodiment")]
        | Annotated[LookAway, tyro.conf.subcommand("look_away")]
        | Annotated[Policies, tyro.conf.subcommand("policies")]
        | Annotated[DWM, tyro.conf.subcommand("dwm")]
        | Annotated[Rank, tyro.conf.subcommand("rank")]
        | Annotated[RealTiny, tyro.conf.subcommand("real_tiny")]
        | Annotated[Debug, tyro.conf.subcommand("debug")]
    )

    def run(self) -> int:
        """Run the chosen experiment."""
        from egosim_jax.io.executables import share_with_jax

        share_with_jax()
        name = MODULES[type(self.command)]
        import_module(f"egosim_jax.experiments.{name}").run(self.command)
        return ExitCode.DONE
