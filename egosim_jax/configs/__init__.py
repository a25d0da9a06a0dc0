"""The released models by name, one file each."""

from __future__ import annotations

import difflib
import importlib
import pkgutil
from pathlib import Path
from typing import TYPE_CHECKING

from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.networks import ModelConfig


SHIPPED = Path(__file__).parents[1] / "weights"
"""Folders of weights that come with the package, by config."""


def names() -> list[str]:
    """Every name that `get` knows."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def get(name: str) -> ModelConfig:
    """The config of that name; an unknown one raises `InputError` with the nearest."""
    if name not in names():
        near = difflib.get_close_matches(name, names(), n=1, cutoff=0.0)
        raise InputError(
            f"There is no config {name!r}. Nearest: {near[0]}. All: {', '.join(names())}. "
            "(--config)"
        )
    return importlib.import_module(f"{__name__}.{name}").CONFIG


def shipped_weights(name: str) -> Path | None:
    """The folder of the weights that come with the package, if the config has any."""
    folder = SHIPPED / name
    return folder if folder.is_dir() else None


def weights_of(name: str, given: Path | None) -> Path:
    """The folder that was given, else the shipped one; `InputError` if there is neither."""
    folder = given or shipped_weights(name)
    if folder is None:
        raise InputError(f"{name} comes without weights. (--weights FOLDER)")
    return folder
