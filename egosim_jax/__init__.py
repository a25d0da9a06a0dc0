"""An egocentric world simulator in JAX: the public names, each imported when it is first used.

generator = egosim_jax.Generator.load("tabletop")
episode = egosim_jax.Episode.load("my_episode")
perception = egosim_jax.get_perception("classical")().build()
simulator = egosim_jax.Simulator(generator=generator, perception=perception, fps=episode.fps)
step = simulator.step(episode.state, episode.actions[0], seed=0)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str

    from egosim_jax.conditioning.condition import Condition
    from egosim_jax.configs import get as get_config
    from egosim_jax.configs.model import ModelConfig, Networks
    from egosim_jax.data.clips import load_triplet
    from egosim_jax.data.metadata import read_metadata
    from egosim_jax.generation.export import write_conditions
    from egosim_jax.generation.generator import Generator
    from egosim_jax.io.writing import write_video
    from egosim_jax.perception.registry import get as get_perception
    from egosim_jax.perception.registry import register as register_perception
    from egosim_jax.simulation.episode import Episode
    from egosim_jax.simulation.rollout import Rollout
    from egosim_jax.simulation.simulator import Simulator, Step
    from egosim_jax.state.depth import state_from_depth
    from egosim_jax.state.instances import find_objects
    from egosim_jax.state.snapshot import load as load_state
    from egosim_jax.state.snapshot import save as save_state
    from egosim_jax.types import (
        Action,
        Cameras,
        Clip,
        GroundTruth,
        InputError,
        Perceived,
        SceneState,
        Triplet,
        VideoSpec,
        View,
    )

__all__ = [
    "Action",
    "Cameras",
    "Clip",
    "Condition",
    "Episode",
    "Generator",
    "GroundTruth",
    "InputError",
    "ModelConfig",
    "Networks",
    "Perceived",
    "Rollout",
    "SceneState",
    "Simulator",
    "Step",
    "Triplet",
    "VideoSpec",
    "View",
    "find_objects",
    "get_config",
    "get_perception",
    "load_state",
    "load_triplet",
    "read_metadata",
    "register_perception",
    "save_state",
    "state_from_depth",
    "write_conditions",
    "write_video",
]

_HOMES = {
    "Condition": ("conditioning.condition", "Condition"),
    "Episode": ("simulation.episode", "Episode"),
    "Generator": ("generation.generator", "Generator"),
    "Rollout": ("simulation.rollout", "Rollout"),
    "find_objects": ("state.instances", "find_objects"),
    "get_config": ("configs", "get"),
    "get_perception": ("perception.registry", "get"),
    "load_state": ("state.snapshot", "load"),
    "load_triplet": ("data.clips", "load_triplet"),
    "read_metadata": ("data.metadata", "read_metadata"),
    "register_perception": ("perception.registry", "register"),
    "save_state": ("state.snapshot", "save"),
    "state_from_depth": ("state.depth", "state_from_depth"),
    "write_conditions": ("generation.export", "write_conditions"),
    "write_video": ("io.writing", "write_video"),
    **{name: ("configs.model", name) for name in ("ModelConfig", "Networks")},
    **{name: ("simulation.simulator", name) for name in ("Simulator", "Step")},
    **{
        name: ("types", name)
        for name in (
            "Action",
            "Cameras",
            "Clip",
            "GroundTruth",
            "InputError",
            "Perceived",
            "SceneState",
            "Triplet",
            "VideoSpec",
            "View",
        )
    },
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib import metadata

        return metadata.version("egosim-jax")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _HOMES[name]
    return getattr(importlib.import_module(f"{__name__}.{module}"), attribute)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
