"""Configs of models: `ModelConfig` in `model.py`, and one file for each released model.

A config chooses the sizes, samplings and weights of a model. Code that runs models is in `models`
and `generation`.

    get, names           config by name
    sampled              config with one of its named samplings
    weights_of           folder of a config's weights: given, shipped or fetched
    trained_on           simulated world whose clips trained the weights
    scene_warning        note about a scene that the weights were not made for
    release, releases    weights on a model hub
"""

from __future__ import annotations

import difflib
import importlib
import json
import pkgutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from egosim_jax.io import hub
from egosim_jax.io.bounded import read_json
from egosim_jax.io.weights import STUDENT, check_folder
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig


SHIPPED = Path(__file__).parents[1] / "weights"
"""Folder of the weights that are shipped with the package, by config."""
RELEASED = Path(__file__).with_name("released.json")
"""Weights on a model hub, by name."""


def names() -> list[str]:
    """Return the names of all configs."""
    return sorted({module.name for module in pkgutil.iter_modules(__path__)} - {"model"})


def get(name: str) -> ModelConfig:
    """Return a config by name. Raises `InputError` with the nearest name for an unknown one."""
    return _module(name).CONFIG


def sampled(config: ModelConfig, sampling: str) -> ModelConfig:
    """Return a model with one of its named samplings; most models have none.

    Raises `InputError` with the nearest name for an unknown one.
    """
    known = getattr(_module(config.name), "SAMPLINGS", {})
    if not known:
        raise InputError(
            f"{config.name} has no named samplings, so no {sampling!r}: omit the option. "
            "(--sampling)"
        )
    if sampling not in known:
        raise InputError(
            f"{config.name} has no sampling {sampling!r}. {_nearest(sampling, known)} (--sampling)"
        )
    return replace(config, **known[sampling])


def allows_random_weights(name: str) -> bool:
    """Return True if a model may generate with random weights, to check that everything runs."""
    return getattr(_module(name), "RANDOM_WEIGHTS", False)


def _module(name: str) -> ModuleType:
    if name not in names():
        raise InputError(f"There is no config {name!r}. {_nearest(name, names())} (--config)")
    return importlib.import_module(f"{__name__}.{name}")


def _nearest(name: str, known: Iterable[str]) -> str:
    """Return the nearest of several names, and all of them, for a message."""
    near = difflib.get_close_matches(name, known := list(known), n=1, cutoff=0.0)
    return f"Nearest: {near[0]}. All: {', '.join(known)}."


def shipped_weights(name: str) -> Path | None:
    """Return the folder of the shipped weights, or None.

    A student's weights are in its teacher's folder.
    """
    if name in names() and (teacher := getattr(_module(name), "SHIPPED_WITH", None)):
        return SHIPPED / teacher if (SHIPPED / teacher / STUDENT).is_file() else None
    folder = SHIPPED / name
    return folder if folder.is_dir() else None


def releases() -> dict[str, hub.Release]:
    """Return the releases of weights that can be fetched, by name."""
    found = json.loads(RELEASED.read_text("utf-8"))
    return {name: hub.Release(name=name, **fields) for name, fields in found.items()}


def release(name: str, *, others: Iterable[str] = ()) -> hub.Release:
    """Return a release by name. Raises `InputError` with the nearest name for an unknown one.

    `others` are names of weights without a release, for the message.
    """
    known = releases()
    if name not in known and (shipped := shipped_weights(name)):
        raise InputError(f"{name} is in the package, so nothing is fetched: {shipped}.")
    if name not in known:
        raise InputError(
            f"There are no released weights {name!r}. {_nearest(name, [*known, *others])} "
            "(egosim models list)"
        )
    return known[name]


def training_of(name: str) -> str | None:
    """Return the command that trains the weights of a config, if one does."""
    return getattr(_module(name), "TRAINING", None)


def _origin(name: str) -> str:
    """Return how to get the weights of a config."""
    if name in releases():
        return f"Fetch them: egosim models fetch {name}"
    if training := training_of(name):
        return f"Train them: {training}"
    return (
        f"Convert a download: egosim convert weights DOWNLOAD --config {name} --out weights/{name}"
    )


def weights_of(name: str, given: Path | None) -> Path:
    """Return the folder of a config's weights: the given, else the shipped, else the fetched one.

    Raises `InputError`, with the command that fetches, trains or converts them, if no weights are
    found.
    """
    if given is not None:
        check_folder(given, name)
    folder = given or shipped_weights(name)
    if folder is None and hub.is_fetched(fetched := hub.fetched_folder(name)):
        folder = fetched
    if folder is None:
        raise InputError(
            f"There are no weights of {name} here. {_origin(name)}. Or name a folder of weights. "
            "(--weights FOLDER)"
        )
    return folder


def trained_on(name: str, folder: Path) -> str | None:
    """Return the simulated world whose clips trained a config's weights; None if it is unknown.

    It is known of the shipped weights, and of runs that made their clips themselves.
    """
    shipped = shipped_weights(name)
    if shipped is not None and folder.resolve() == shipped.resolve():
        return "tabletop"
    run = folder.parent / "config.json"
    if folder.name == "weights" and run.is_file():
        with suppress(InputError):  # damaged: the world is unknown
            written = read_json(run)
            if isinstance(written, dict) and written.get("type") == "FromTabletop":
                return "tabletop"
    return None


def scene_warning(world: str | None, provenance: Mapping[str, str]) -> str | None:
    """Return a note in one line if weights of a world were not made for a scene, else None.

    `world` is from `trained_on`, `provenance` from the scene's state.
    """
    if world is None or provenance.get("world") == world:
        return None
    return (
        f"The weights were trained on clips of the {world} world, and this scene is not of it: "
        "expect blurred clips, whose objects may stay or turn where a hand carries them. Train on "
        f"your own clips ({training_of('real_tiny')}), or fetch EgoSim's weights (egosim "
        "models fetch egosim_14b) for --config egosim_14b."
    )
