"""Clean the hand joints of a dataset for a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from egosim_jax.data.recording import Recording
from egosim_jax.types import HAND_SIZE_M, Cameras, InputError, near_view


def clean_joints(
    joints_m: Float[np.ndarray, "f n j 3"] | None, cameras: Cameras | None
) -> tuple[Float[np.ndarray, "f n j 3"] | None, dict[str, str]]:
    """Return joints with NaN for hands that are implausible or never near the view, and counts.

    Returns None and no counts if joints are missing. Without cameras, the view is not known.

    Raises `InputError` if there are hands but none is ever near the view, because then joints and
    cameras are not in one world.
    """
    if joints_m is None:
        return None, {}
    joints = np.array(joints_m, float)
    finite = np.isfinite(joints).all(axis=(2, 3))
    joints[~finite] = np.nan
    extent = np.linalg.norm(np.ptp(joints, axis=2), axis=-1)
    low, high = HAND_SIZE_M
    odd = finite & ~((extent >= low) & (extent <= high))
    joints[odd] = np.nan
    present = np.isfinite(joints).all(axis=(2, 3)).any(axis=0)
    seen = present if cameras is None else near_view(cameras, joints).any(axis=0)
    if present.any() and not seen.any():
        raise InputError(
            "No hand joint comes near the view of the camera in any frame: joints and camera poses "
            "must be in one world, in meters. The recording cannot be used for hands."
        )
    joints[:, ~seen] = np.nan
    counts = {
        "hands_implausible": int(odd.sum()),
        "hands_never_in_view": int((present & ~seen).sum()),
    }
    return joints, {name: str(count) for name, count in counts.items() if count}


def with_joints(recording: Recording, joints_m: Float[np.ndarray, "f n j 3"] | None) -> Recording:
    """Return a recording with clean joints; its provenance ends with the counts."""
    joints, counts = clean_joints(joints_m, recording.cameras)
    return replace(recording, joints_m=joints, provenance={**recording.provenance, **counts})
