"""Static twins of clips: the scene as it was in the first frame, and the hands as meshes.

They are the conditions of DWM. The static video is ray cast from the same geometry along the same
cameras as the clip, without hands, so that both differ by what the hands do and hide alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from egosim_jax.rendering.hand_mesh import pose_hands
from egosim_jax.rendering.mesh import hand_mask
from egosim_jax.rendering.mesh_reference import draw_mesh
from egosim_jax.types import InputError, Triplet
from egosim_jax.worlds.tabletop import TabletopClip
from egosim_jax.worlds.tabletop.raycast import RayCaster

PriorName = Literal["state", "static"]
"""Rendering of the scene: points of a state, or the scene as it was in the first frame."""
HandsName = Literal["skeleton", "mesh", "mask"]
"""Rendering of the hands: skeletons, shaded meshes, or the binary mask of the meshes."""


def with_conditions(
    clip: TabletopClip, triplet: Triplet, prior: PriorName, hands: HandsName
) -> Triplet:
    """Return the triplet of a clip with another rendering of the scene and of the hands.

    A static prior is observed everywhere: its mask is 0. Raises `InputError` for the mesh of a
    gripper.
    """
    if prior == "static":
        frames = static_video(clip)
        triplet = replace(
            triplet, prior=frames, first_frame=frames[0], mask=np.zeros_like(triplet.mask)
        )
    if hands != "skeleton":
        meshes = hand_video(clip)
        triplet = replace(triplet, hands=hand_mask(meshes) if hands == "mask" else meshes)
    return triplet


def static_video(clip: TabletopClip) -> UInt8[np.ndarray, "f h w 3"]:
    """Return the scene as it was in the clip's first frame, along its cameras, without hands."""
    caster, cameras = RayCaster(clip.scene.placed()), clip.cameras
    pictures = [
        caster.render(pose, cameras.intrinsics_px, height=cameras.height, width=cameras.width)
        for pose in cameras.world_from_camera
    ]
    return np.stack([picture.colors for picture in pictures])


def hand_video(clip: TabletopClip) -> UInt8[np.ndarray, "f h w 3"]:
    """Return the shaded meshes of the clip's hands on black. Raises `InputError` for grippers."""
    if clip.kind != "human":
        raise InputError(
            f"The clip of seed {clip.seed} has hands of kind {clip.kind}, which have no mesh: only "
            "human hands have. (--kind, --hands)"
        )
    return draw_mesh(pose_hands(clip.joints_m, sides=clip.sides), clip.cameras)[0]
