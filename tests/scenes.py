"""Pinhole cameras, states and actions without hands, for tests."""

import numpy as np

from egosim_jax.types import Action, Cameras, SceneState


def pinhole(poses, focal_px, height, width):
    """Cameras at poses, or a camera at rest for a number of frames; their center is the image's."""
    poses = np.tile(np.eye(4), (poses, 1, 1)) if isinstance(poses, int) else np.asarray(poses)
    matrix = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    return Cameras(world_from_camera=poses, intrinsics_px=matrix, height=height, width=width)


def state_of(points_m, *, colors=0, ids=0, intrinsics_px=None, **fields):
    """A state of points; all of them may have one color and one id."""
    count = len(points_m)
    return SceneState(
        points_m=np.asarray(points_m, np.float32),
        colors=np.broadcast_to(colors, (count, 3)).astype(np.uint8),
        object_ids=np.broadcast_to(ids, count).astype(np.int32),
        last_seen=np.zeros(count, np.int32),
        intrinsics_px=np.eye(3) if intrinsics_px is None else intrinsics_px,
        **fields,
    )


def without_hands(cameras):
    """An action that shows no hand."""
    joints = np.full((len(cameras.world_from_camera), 1, 21, 3), np.nan)
    return Action(cameras=cameras, joints_m=joints, kind="human", prompt="")
