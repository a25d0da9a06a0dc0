"""Fusion of any flat scene: what was seen already changes nothing, whatever its order."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from egosim_jax.state.fuse import fuse
from egosim_jax.state.snapshot import fingerprint
from egosim_jax.state.tsdf import Fusion
from egosim_jax.types import Cameras, Perceived, SceneState

HEIGHT, WIDTH, FRAMES = 24, 32, 3
INTRINSICS = np.array([[40.0, 0, (WIDTH - 1) / 2], [0, 40, (HEIGHT - 1) / 2], [0, 0, 1]])
FUSION = Fusion(voxel_m=0.01)


def seen(depth_m, color, step, aside_m=0.0):
    """A wall at a depth, before a camera at rest."""
    pose = np.eye(4)
    pose[0, 3] = aside_m
    size = (FRAMES, HEIGHT, WIDTH)
    return Perceived(
        step=step,
        frames=np.full((*size, 3), color, np.uint8),
        cameras=Cameras(
            world_from_camera=np.repeat(pose[None], FRAMES, axis=0),
            intrinsics_px=INTRINSICS,
            height=HEIGHT,
            width=WIDTH,
        ),
        depth_m=np.full(size, depth_m, np.float32),
        object_ids=np.zeros(size, np.int32),
        names={},
        world_from_object={},
        interacted_frames={},
    )


def empty():
    """A state of one point, which no camera sees."""
    return SceneState(
        points_m=np.array([[50.0, 50, 50]], np.float32),
        colors=np.zeros((1, 3), np.uint8),
        object_ids=np.zeros(1, np.int32),
        last_seen=np.zeros(1, np.int32),
        intrinsics_px=INTRINSICS,
    )


@settings(max_examples=6)
@given(st.floats(0.3, 0.9), st.integers(0, 255))
def test_fusing_the_same_clip_again_changes_nothing(depth_m, color):
    clip = seen(depth_m, color, step=1)
    once = fuse(empty(), clip, fusion=FUSION)
    assert len(once.points_m) > 100
    assert fingerprint(fuse(once, clip, fusion=FUSION)) == fingerprint(once)


@settings(max_examples=4)
@given(st.floats(0.3, 0.6), st.floats(2.0, 4.0))
def test_clips_of_two_places_may_come_in_either_order(depth_m, aside_m):
    left, right = seen(depth_m, 90, step=1), seen(depth_m, 90, step=1, aside_m=aside_m)
    there, back = (
        fuse(fuse(empty(), first, fusion=FUSION), second, fusion=FUSION)
        for first, second in ((left, right), (right, left))
    )
    np.testing.assert_array_equal(there.points_m, back.points_m)
    np.testing.assert_array_equal(there.colors, back.colors)
