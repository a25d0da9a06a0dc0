"""Actions with hands out of view: a model is not given them, the true world still moves them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import no_type_check

import numpy as np
from jaxtyping import Float

from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.simulation.actions import load_action, save_action
from egosim_jax.types import Action, InputError, Kind

PLACES = "_hands.npz"
"""End of the name of a file with the joints of all hands, next to that of its action."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class PlacedAction(Action):
    """Action in which a hand out of view is missing, and the joints of all hands."""

    placed_m: Float[np.ndarray, "f n j 3"]
    """Joints of all hands in the world, in meters, also of those that `joints_m` misses."""

    def __post_init__(self) -> None:
        """Check as `Action` does, and that all places are given and agree with the joints."""
        super().__post_init__()
        placed, joints = np.asarray(self.placed_m), np.asarray(self.joints_m)
        agree = placed.shape == joints.shape and np.isfinite(placed).all()
        if not agree or not (np.isnan(joints) | (joints == placed)).all():
            raise InputError(
                f"placed_m is {placed.dtype} {placed.shape}: it must have the finite joints of all "
                f"hands {joints.shape}, equal to joints_m where that has any."
            )


def places_of(action: Action) -> Float[np.ndarray, "f n j 3"]:
    """Return the joints of all hands of an action, also of those out of view if it knows them."""
    return action.placed_m if isinstance(action, PlacedAction) else action.joints_m


def with_places(action: Action, placed_m: Float[np.ndarray, "f n j 3"]) -> PlacedAction:
    """Return an action that knows the joints of all hands."""
    own = {field.name: getattr(action, field.name) for field in fields(Action)}
    return PlacedAction(**own, placed_m=placed_m)


def save_placed(folder: Path, name: str, action: Action) -> None:
    """Write an action to NAME.npz, and the joints of hands out of view next to it."""
    save_action(folder / f"{name}.npz", action)
    if isinstance(action, PlacedAction):
        with atomic_write(folder / f"{name}{PLACES}") as temporary:
            np.savez(temporary, placed_m=np.ascontiguousarray(action.placed_m, float))


def load_placed(
    folder: Path, name: str, *, kind: Kind, size: tuple[int, int], prompt: str
) -> Action:
    """Read what `save_placed` wrote; `size` is height and width of the action's pictures."""
    action = load_action(folder / f"{name}.npz", kind=kind, size=size, prompt=prompt)
    path = folder / f"{name}{PLACES}"
    if not path.exists():
        return action
    return with_places(action, read_arrays(path, {"placed_m": "float64"})["placed_m"])
