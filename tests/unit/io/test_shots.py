"""Shots of a camera or of a video in its place, and the errors without them."""

import time

import cv2
import numpy as np
import pytest

from egosim_jax.io import shots
from egosim_jax.io.shots import MAX_SIDE, Shots
from egosim_jax.io.writing import write_video
from egosim_jax.types import InputError


@pytest.fixture
def video(tmp_path):
    """A video whose frames become brighter, and are larger than shots."""
    frames = np.repeat(np.arange(10, 250, 20, dtype=np.uint8), 3 * 48 * 1280)
    write_video(tmp_path / "hand.mp4", frames.reshape(-1, 48, 1280, 3), 10)
    return tmp_path / "hand.mp4"


def test_a_video_is_played_at_its_rate_and_old_frames_are_dropped(video):
    source, begun_s = Shots(str(video)), time.monotonic()
    source.start()
    first = source.take(5.0)
    assert first.frame.shape == (24, MAX_SIDE, 3)
    assert source.take(0.0) is None
    time.sleep(0.5)
    later = source.take(5.0)
    assert later.frame.mean() > first.frame.mean() + 50
    while not source.ended:
        time.sleep(0.01)
    assert time.monotonic() - begun_s > 1.0
    assert "has ended" in source.ended
    source.close()


def test_a_source_that_was_not_started_is_closed(video):
    Shots(str(video)).close()


def test_a_missing_camera_is_refused_with_what_was_tried():
    with pytest.raises(InputError, match=r"Camera 77 cannot .* tried .*another camera.*--camera"):
        Shots("77")


def test_a_missing_video_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no video .*named by its number"):
        Shots(str(tmp_path / "none.mp4"))


def test_a_file_that_is_no_video_is_refused(tmp_path):
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(InputError, match="not a readable video"):
        Shots(str(tmp_path / "text.mp4"))


class Unplugged:
    """A camera that gives two frames."""

    left = 2

    def __init__(self, number):
        pass

    def isOpened(self):  # noqa: N802
        return True

    def set(self, name, value):
        return True

    def read(self):
        self.left -= 1
        return (True, np.zeros((480, 1280, 3), np.uint8)) if self.left >= 0 else (False, None)

    def release(self):
        pass


def test_a_camera_that_stops_is_reported(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", Unplugged)
    monkeypatch.setattr(shots, "DEAD_S", 0.1)
    source = Shots("0")
    source.start()
    while not source.ended:
        time.sleep(0.01)
    assert source.ended.startswith("Camera 0 gave 2 frames and then none for 0.1 s")
    assert source.take(0.0).frame.shape == (240, 640, 3)
    source.close()
