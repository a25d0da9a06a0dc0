"""Silhouettes of tracked hands, drawn without cameras."""

import numpy as np
import pytest

from egosim_jax.geometry import invert, project, transform
from egosim_jax.perception.video.estimates import HandTracks
from egosim_jax.perception.video.silhouettes import track_silhouettes
from egosim_jax.worlds.tabletop.scene import FIRST_HAND
from tests.unit.perception.posed import make_clip


@pytest.fixture(scope="module")
def clip():
    return make_clip()


@pytest.fixture(scope="module")
def tracks(clip):
    local = transform(invert(clip.cameras.world_from_camera)[:, None], clip.joints_m)
    missing = ((0, 0), (0, 2 - local.shape[1]), (0, 0), (0, 0))
    joints = np.pad(local, missing, constant_values=np.nan)
    return HandTracks(
        joints_px=np.stack(project(clip.cameras.intrinsics_px, joints), axis=-1),
        joints_hand_m=joints - joints[:, :, :1],
        presence=np.isfinite(joints).all(axis=(2, 3)).astype(float),
    )


def test_they_cover_the_hands_and_little_else(clip, tracks):
    covered = track_silhouettes(clip.frames, tracks)
    hands = clip.ids >= FIRST_HAND
    assert (covered & hands).sum() / hands.sum() > 0.9
    assert covered.mean() < 3 * hands.mean()
