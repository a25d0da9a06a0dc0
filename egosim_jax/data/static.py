"""Check that conditions are a static scene and hand meshes, as DWM's models need."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.manifest import Manifest
from egosim_jax.types import InputError

HALF_WHITE = 127
"""Maximum gray level of an observed pixel: half of 255, rounded down."""
MAX_UNOBSERVED = 0.01
"""Maximum fraction of unobserved pixels in a static video: gaps between rendered points."""
FIX = "Make others with `egosim data make tabletop --prior static --hands mesh`"


def check_observed(mask: UInt8[np.ndarray, "f h w"]) -> None:
    """Raise `InputError` if a mask video (255 = not observed) has more than small gaps."""
    share = np.count_nonzero(mask > HALF_WHITE) / mask.size
    if share > MAX_UNOBSERVED:
        raise InputError(
            f"The mask says that {share:.1%} of the pixels were not observed: DWM's static video "
            f"has no mask, so at most {MAX_UNOBSERVED:.0%} may be unobserved. "
            f"{FIX}, or with `egosim data static` from a scene that fills the view."
        )


def check_static(manifest: Manifest, *, source: str) -> None:
    """Raise `InputError` for shards whose manifest says that they have EgoSim's conditions."""
    prior, hands = (manifest.provenance.get(name) for name in ("prior", "hands"))
    if prior == "state" or hands == "skeleton":
        raise InputError(
            f"{source} holds clips of prior {prior} and hands {hands}: a DWM model needs a static "
            f"prior, and hands as mesh or mask. {FIX}. (--shards)"
        )
