"""Conditions of an action as files, for EgoSim's own loader and for `egosim generate`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.clips import write_clips
from egosim_jax.rendering import Renderer, jitted
from egosim_jax.types import Action, SceneState, Triplet


def write_conditions(
    folder: Path | str,
    state: SceneState,
    action: Action,
    *,
    fps: int,
    video_id: str = "clip_1",
    first_frame: UInt8[np.ndarray, "h w 3"] | None = None,
    renderer: Renderer = jitted,
) -> Path:
    """Write prior, mask and hand videos of an action in EgoSim's layout; return its metadata.csv.

    Other clips in the folder keep their rows there; one of the same `video_id` is replaced.
    Without a first frame it is that of the view. Raises `InputError` if the first camera sees none
    of the state, and for a `video_id` that is not a valid file name.
    """
    view = renderer.render(state, action.cameras, point_px=2)
    triplet = Triplet(
        video_id=video_id,
        prompt=action.prompt,
        prior=view.frames,
        mask=view.mask,
        hands=renderer.draw_hands(action.joints_m, action.cameras, kind=action.kind)[0],
        first_frame=view.frames[0] if first_frame is None else first_frame,
    )
    return write_clips(Path(folder), [triplet], fps=fps, append=True)
