"""`egosim experiment`: run a documented experiment by one command that resumes."""

from __future__ import annotations

from importlib import import_module
from typing import Any

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
    TrainPolicy,
    Update,
)
from egosim_jax.runtime.command import ExitCode, group

KINDS = {
    "tabletop": Tabletop,
    "continuous": Continuous,
    "students": Students,
    "update": Update,
    "embodiment": Embodiment,
    "look_away": LookAway,
    "policies": Policies,
    "dwm": DWM,
    "rank": Rank,
    "train_policy": TrainPolicy,
    "real_tiny": RealTiny,
    "debug": Debug,
}
"""Settings of each experiment, which has the module of its name in `egosim_jax.experiments`."""
MODULES = {kind: name for name, kind in KINDS.items()} | {Debug: "real_tiny"}


def _run(self: Any) -> int:
    from egosim_jax.io.executables import share_with_jax

    share_with_jax()
    module = import_module(f"egosim_jax.experiments.{MODULES[type(self.command)]}")
    module.run(self.command)
    return ExitCode.DONE


ABOUT = "Repeat a documented experiment, from training to its table, by one command."
Experiment = group("Experiment", ABOUT, KINDS, run=_run)
