"""Checks that conditions are a static scene and hand meshes, which DWM's models need."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.manifest import Manifest
from egosim_jax.types import InputError

HALF_WHITE = 127
"""Highest gray level that is not above one half of 255."""
MAX_UNOBSERVED = 0.01
"""Largest share of unobserved pixels in a static video: pinholes between rendered points."""
FIX = "Make others with `egosim data make tabletop --prior static --hands mesh`"


def check_observed(mask: UInt8[np.ndarray, "f h w"]) -> None:
    """Raise `InputError` if a mask video (255 = not observed) has more than pinholes."""
    share = np.count_nonzero(mask > HALF_WHITE) / mask.size
    if share > MAX_UNOBSERVED:
        raise InputError(
            f"The mask says that {share:.1%} of the pixels were not observed: the static video of "
            f"DWM must show all of the scene, but for {MAX_UNOBSERVED:.0%}, as it has no mask. "
            f"{FIX}, or with `egosim data static` from a scene that fills the view."
        )


def check_static(manifest: Manifest, *, source: str) -> None:
    """Raise `InputError` for shards whose manifest says that they have EgoSim's conditions."""
    have = {name: manifest.provenance.get(name) for name in ("prior", "hands")}
    if have["prior"] == "state" or have["hands"] == "skeleton":
        raise InputError(
            f"{source} holds clips of prior {have['prior']} and hands {have['hands']}: a model of "
            f"DWM needs a static prior, and hands as mesh or mask. {FIX}. (--shards)"
        )
