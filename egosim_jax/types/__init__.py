"""Data types that the parts of the simulator pass to each other, and the glossary of shapes.

Frozen dataclasses with checks belong here. Operations on them do not, and no module imports jax: a
generator in any framework can use these types.

    Triplet, Clip, Action, View, SceneState, Perceived, GroundTruth   the data flow (`data.py`)
    Motion, ObjectPath, Cause                                         predictions (`motion.py`)
    Cameras, is_rigid                                                 camera paths (`cameras.py`)
    Video, Masks, Pose, Points, ...                                   shapes (`arrays.py`)
    InputError, Counted, VideoSpec, VideoGrid, MeshConfig, check_*    sizes (`settings.py`)

Shapes are channel-last everywhere:

    b batch    f frames (pixel frames of a video, or latent frames of its latents)
    h w        rows and columns (pixels, or latent cells of 8 x 8 pixels)
    c          channels: 3 for RGB, 16 for latents, 52 for the denoiser's input
    n d        tokens and their width

Videos on disk and in `Triplet` are uint8 RGB; models see RGB in [-1, 1]. A video of F = 4k+1
frames has k+1 latent frames: the first latent frame encodes one frame, the others four each.
Masks are 1 (or 255) where nothing was observed and pixels must be generated, and 0 where the prior
is kept.
"""

from __future__ import annotations

from egosim_jax.types.cameras import FOCAL_WIDTHS, MAX_SKEW, Cameras, check_rigid, is_rigid
from egosim_jax.types.data import (
    HAND_SIZE_M,
    JOINTS,
    NEAR_IMAGE,
    REACH_M,
    Action,
    Clip,
    GroundTruth,
    Kind,
    Perceived,
    SceneState,
    Triplet,
    View,
    check_hands,
    near_view,
    object_name,
    seen_hands,
)
from egosim_jax.types.motion import Cause, How, Motion, ObjectPath
from egosim_jax.types.settings import (
    WAN_GRID,
    Counted,
    InputError,
    MeshConfig,
    VideoGrid,
    VideoSpec,
    check_counts,
    check_seed,
    check_video,
)
from egosim_jax.types.shown import Shown

__all__ = [
    "FOCAL_WIDTHS",
    "HAND_SIZE_M",
    "JOINTS",
    "MAX_SKEW",
    "NEAR_IMAGE",
    "REACH_M",
    "WAN_GRID",
    "Action",
    "Cameras",
    "Cause",
    "Clip",
    "Counted",
    "GroundTruth",
    "How",
    "InputError",
    "Kind",
    "MeshConfig",
    "Motion",
    "ObjectPath",
    "Perceived",
    "SceneState",
    "Shown",
    "Triplet",
    "VideoGrid",
    "VideoSpec",
    "View",
    "check_counts",
    "check_hands",
    "check_rigid",
    "check_seed",
    "check_video",
    "is_rigid",
    "near_view",
    "object_name",
    "seen_hands",
]
