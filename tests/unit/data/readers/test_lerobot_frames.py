"""Frames of one episode of a LeRobot dataset, from its video."""

import numpy as np
import pytest

from egosim_jax.data.readers.lerobot import read_info
from egosim_jax.data.readers.lerobot_frames import frames_of
from egosim_jax.types import InputError
from tests.unit.data.readers.test_lerobot import KEY, write_v3


def test_frames_of_a_shared_video_are_the_episodes_own(world, tmp_path):
    write_v3(tmp_path / "set", world)
    frames = frames_of(tmp_path / "set", read_info(tmp_path / "set"), 1, KEY)
    assert (frames.count, frames.fps) == (5, 30)
    shown = frames.read(3, lambda frame: frame[2:6, 2:6])
    np.testing.assert_allclose(shown.mean(axis=(1, 2, 3)), 10 + 20 * np.arange(7, 10), atol=8)
    np.testing.assert_array_equal(frames.first[2:6, 2:6], shown[0])


@pytest.mark.parametrize("camera", [None, "side"])
def test_a_camera_that_is_not_clear_is_refused_with_the_names(world, tmp_path, camera):
    write_v3(tmp_path / "set", world)
    with pytest.raises(InputError, match=r"observation\.images\.wrist"):
        frames_of(tmp_path / "set", read_info(tmp_path / "set"), 1, camera)
