"""Shots: frames of a camera of this machine, or of a video that is played in its place.

A thread reads them as they come. Only the newest one is kept, so a slow consumer sees fewer frames
and never old ones. A video is played at its own rate, by `decoding`, which says what it refuses.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import no_type_check

import cv2
import numpy as np
from av.video.reformatter import VideoReformatter
from jaxtyping import UInt8

from egosim_jax.io.bounded import open_regular, quote_path
from egosim_jax.io.decoding import decode_frames, open_video, to_rgb
from egosim_jax.types import InputError

MAX_SIDE = 640
"""Maximum side of a frame in pixels; larger ones are shrunk."""
DEAD_S = 3.0
"""Time without a frame after which a camera counts as stopped, in seconds."""
ANOTHER = "Give the number of another camera, or a video file. (--camera)"


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Shot:
    """Frame and the time at which it was there."""

    frame: UInt8[np.ndarray, "h w 3"]
    """Frame in RGB."""
    time_s: float
    """Time of `time.monotonic`."""


class Shots:
    """Newest shot of a camera or video, read by a thread."""

    def __init__(self, source: str):
        """Open a camera by its number, or else a video file, and wait for the first frame.

        Raises `InputError` without one.
        """
        self.ended = ""
        """Why there are no more frames; empty while there are."""
        self._newest: Shot | None = None
        self._coming, self._closed = threading.Condition(), False
        self._frames = _filmed(int(source)) if source.isdecimal() else _played(Path(source))
        self._first = next(self._frames)
        self._thread = threading.Thread(target=self._read, name="shots", daemon=True)

    def start(self) -> None:
        """Read the following frames."""
        self._thread.start()

    def take(self, timeout_s: float) -> Shot | None:
        """Return the newest shot that was not taken yet; None if none comes in time."""
        with self._coming:
            self._coming.wait_for(lambda: self._newest, timeout_s)
            shot, self._newest = self._newest, None
            return shot

    def close(self) -> None:
        """End the thread, and with it the camera."""
        self._closed = True
        if self._thread.is_alive():
            self._thread.join(DEAD_S)
        else:
            self._frames.close()

    def _read(self) -> None:
        """Keep the newest frame until the camera or the video ends."""
        ended, frame = "The video in place of a camera has ended.", self._first
        try:
            while not self._closed:
                with self._coming:
                    self._newest = Shot(frame=frame, time_s=time.monotonic())
                    self._coming.notify_all()
                frame = next(self._frames)
        except StopIteration:
            pass
        except InputError as error:
            ended = str(error)
        finally:
            self._frames.close()
            with self._coming:
                self.ended = ended
                self._coming.notify_all()


def _filmed(number: int) -> Generator[np.ndarray]:
    """Yield the frames of a camera as they come."""
    with _camera(number) as camera:
        count, last_s = 0, time.monotonic()
        while time.monotonic() - last_s < DEAD_S:
            there, frame = camera.read()
            if there and frame is not None:
                count, last_s = count + 1, time.monotonic()
                yield _shrunk(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))
            else:
                time.sleep(0.02)
    raise InputError(
        f"Camera {number} gave {count} frames and then none for {DEAD_S:g} s: it may be unplugged "
        f"or in use by another program. {ANOTHER}"
    )


@contextmanager
def _camera(number: int) -> Iterator[cv2.VideoCapture]:
    """Open a camera. Raises `InputError` with what was tried."""
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)  # the error below says more
    try:
        camera = cv2.VideoCapture(number)
    finally:
        cv2.utils.logging.setLogLevel(before)
    if not camera.isOpened():
        camera.release()
        apis = [cv2.videoio_registry.getBackendName(b) for b in _camera_apis()]
        seen = sorted(str(path) for path in Path("/dev").glob("video*"))
        raise InputError(
            f"Camera {number} cannot be opened: OpenCV tried {', '.join(apis) or 'no interface'}; "
            f"devices of this machine: {', '.join(seen) or 'no /dev/video*'}. {ANOTHER}"
        )
    camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # or frames are some tenths of a second old
    try:
        yield camera
    finally:
        camera.release()


def _camera_apis() -> list[int]:
    return list(cv2.videoio_registry.getCameraBackends())


def _played(path: Path) -> Generator[np.ndarray]:
    """Yield the frames of a video at its own rate."""
    if not path.exists():
        raise InputError(
            f"There is no video {quote_path(path)}, and a camera is named by its number, such as "
            "0. (--camera)"
        )
    name, scaler, begun_s = quote_path(path), VideoReformatter(), time.monotonic()
    with open_regular(path) as file, open_video(file, name) as stream:
        for number, frame in enumerate(decode_frames(stream, name)):
            rgb = to_rgb(stream, frame, "accurate", scaler, max_side=MAX_SIDE)
            step = stream.time_base  # the last frames of a decoder have no unit
            at_s = number / 30 if frame.pts is None or not step else float(frame.pts * step)
            if not number:
                begun_s = time.monotonic() - at_s
            time.sleep(max(0.0, begun_s + at_s - time.monotonic()))
            yield rgb
            if not number:
                begun_s = time.monotonic() - at_s  # it waited until it was wanted


def _shrunk(frame: np.ndarray) -> np.ndarray:
    factor = MAX_SIDE / max(frame.shape[:2])
    if factor >= 1:
        return frame
    return cv2.resize(frame, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
