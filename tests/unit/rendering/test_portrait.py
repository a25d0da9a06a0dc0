"""Portraits of clouds of any number of points and any size."""

import time

import numpy as np
import pytest

from egosim_jax.rendering.portrait import MAX_POINT_PX, portrait
from egosim_jax.types import SceneState

UP = np.array([0.0, 0.0, 1.0])
NOISE = np.random.default_rng(0).normal(size=(50, 3))
CLOUDS = {
    "one": NOISE[:1],
    "two": NOISE[:2],
    "three": NOISE[:3],
    "five": NOISE[:5],
    "equal": np.ones((4, 3)),
    "line": np.outer(np.arange(5), [1, 2, 3]),
    "millimeters": NOISE * 1000,
    "huge": NOISE[:5] * 1e30,
    "tiny": NOISE[:5] * 1e-9,
    "outlier": np.vstack([np.zeros((3, 3)), [[1e6, 0, 0]]]),
    "two clusters": np.vstack([np.zeros((2, 3)), 50 * np.ones((2, 3))]),
}


def state_of(points):
    count = len(points)
    return SceneState(
        points_m=points.astype(np.float32),
        colors=np.full((count, 3), 200, np.uint8),
        object_ids=np.zeros(count, np.int32),
        last_seen=np.zeros(count, np.int32),
        intrinsics_px=np.array([[100.0, 0, 49.5], [0, 100, 29.5], [0, 0, 1]]),
        step=0,
    )


@pytest.mark.parametrize("name", CLOUDS)
def test_every_cloud_is_drawn_within_seconds(name):
    portrait(state_of(NOISE), up=UP)  # Open3D is imported
    then = time.thread_time()
    images = portrait(state_of(CLOUDS[name]), up=UP)
    assert time.thread_time() - then < 20
    drawn = (images > 0).any(axis=-1).sum(axis=(1, 2))
    assert (drawn > 0).all()
    assert (drawn <= len(CLOUDS[name]) * MAX_POINT_PX**2).all()
