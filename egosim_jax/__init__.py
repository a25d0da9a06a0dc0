"""An egocentric world simulator in JAX: the public names, each imported when it is first used.

generator = egosim_jax.Generator.load("tabletop")
clips = generator.generate(triplets, seeds=[0])
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str

    from egosim_jax.conditioning.condition import Condition
    from egosim_jax.configs import get as get_config
    from egosim_jax.data.clips import load_triplet
    from egosim_jax.data.metadata import read_metadata
    from egosim_jax.generator import Generator
    from egosim_jax.networks import ModelConfig, Networks
    from egosim_jax.types import Clip, InputError, Triplet, VideoSpec

__all__ = [
    "Clip",
    "Condition",
    "Generator",
    "InputError",
    "ModelConfig",
    "Networks",
    "Triplet",
    "VideoSpec",
    "get_config",
    "load_triplet",
    "read_metadata",
]

_HOMES = {
    "Condition": ("conditioning.condition", "Condition"),
    "get_config": ("configs", "get"),
    "load_triplet": ("data.clips", "load_triplet"),
    "read_metadata": ("data.metadata", "read_metadata"),
    "Generator": ("generator", "Generator"),
    **{name: ("networks", name) for name in ("ModelConfig", "Networks")},
    **{name: ("types", name) for name in ("Clip", "InputError", "Triplet", "VideoSpec")},
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib import metadata

        return metadata.version("egosim-jax")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _HOMES[name]
    return getattr(importlib.import_module(f"{__name__}.{module}"), attribute)
