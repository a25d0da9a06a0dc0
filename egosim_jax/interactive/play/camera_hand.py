"""Hand of a camera on the page: three threads that draw it, foresee its objects, and paint clips.

The hand and the predicted objects are drawn at once. Clips of the poses follow, part by part, as a
steered hand's do, so every moment can be undone, replayed and saved. A control of the page pauses
the hand.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from statistics import median

import cv2
import numpy as np
import viser

from egosim_jax.interactive.play.following import Following
from egosim_jax.interactive.play.own_hand import Phase
from egosim_jax.interactive.play.viewer import Page
from egosim_jax.io.bounded import quote_text
from egosim_jax.io.shots import Shot, Shots
from egosim_jax.perception.video.hands.live import LiveHand
from egosim_jax.rendering.skeleton import SKELETONS
from egosim_jax.types import InputError

ABOUT: dict[Phase, str] = {
    "calibrate": "Hold your open hand still in the camera's view for a second.",
    "follow": "Your hand is followed. Pinch to grasp.",
    "hold": "Your hand is not seen.",
    "retreat": "Your hand is not seen: the hand has opened and goes back. Show yours again.",
}
BEGIN = "Press *follow*, then hold your open hand still in the camera's view for a second."
PAUSED = "Paused: press *follow* to continue."
LATE_S = 0.5
"""Time without a frame after which the hand counts as not seen, in seconds."""
FORESEE_S = 0.05
"""Minimum time between two predictions, in seconds."""
SHOWN_S = 0.15
"""Minimum time between two of the camera's frames on the page, in seconds."""
WIDTH = 320
"""Width of the camera's frames on the page in pixels."""
COUNTED = 300
"""Number of the last latencies; the page shows their median."""


class CameraHand:
    """A wearer's own hand in an episode on the page."""

    def __init__(self, server: viser.ViserServer, page: Page, shots: Shots, tracker: LiveHand):
        """Add the controls; the camera starts when a person presses *follow*."""
        self._server, self._page, self._shots, self._tracker = server, page, shots, tracker
        self._following = Following(page.played)
        self._latencies = {name: deque(maxlen=COUNTED) for name in ("hand", "objects", "painted")}
        self._ended, self._begun, self._paused = threading.Event(), threading.Event(), False
        self._shown_s = self._painted_s = self._shot_s = 0.0
        page.before_change = self._pause
        with server.gui.add_folder("Your hand", order=page.top + 0.5):
            self._about = server.gui.add_markdown(BEGIN)
            self._camera = server.gui.add_image(np.zeros((1, 1, 3), np.uint8), label="Camera")
            names = ("follow", "pause", "calibrate again")
            group = server.gui.add_button_group("The hand", names)
            group.on_click(lambda event: self._choose(event.target.value))
        self._threads = [
            threading.Thread(target=self._repeat, args=(run,), name=run.__name__, daemon=True)
            for run in (self._track, self._foresee, self._paint)
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the camera, and the clip that is made."""
        self._ended.set()
        self._begun.set()
        self._pause()
        for thread in self._threads:
            thread.join(10)
        self._shots.close()

    def _repeat(self, run: Callable[[], None]) -> None:
        """Run a step of a thread until the end, once a person has begun."""
        self._begun.wait()
        while not self._ended.is_set():
            try:
                run()
            except (InputError, FloatingPointError) as error:
                self._pause()
                self._about.content = quote_text(str(error))

    def _choose(self, name: str) -> None:
        if name != "follow":
            self._pause()
        if name == "calibrate again":
            self._following.own.calibrate()
        if name != "pause":
            self._paused = False
        if name == "follow" and not self._begun.is_set():
            self._shots.start()
            self._begun.set()

    def _pause(self) -> None:
        """Stop to follow the hand; the clip that is made ends where the hand is."""
        self._paused, self._page.live = True, False
        self._following.recorder.pause()

    def _track(self) -> None:
        """Draw the hand of the next frame."""
        shot, joints_m, time_s = self._shots.take(0.1), None, time.monotonic()
        if shot is not None:
            joints_m, time_s = self._tracker.see(shot.frame, shot.time_s), shot.time_s
            self._shot_s = time_s
        elif not self._shots.ended and time_s - self._shot_s < LATE_S:
            return
        hand, own = self._following.see(joints_m, time_s), self._following.own
        if self._following.recorder.live:
            self._page.show_hand(hand)
            if shot is not None and joints_m is not None:
                self._latencies["hand"].append(time.monotonic() - time_s)
        elif own.phase == "follow" and not self._paused:
            with self._page.changing:
                self._following.begin(self._page.played)
                self._page.live = True
        if time.monotonic() - self._shown_s > SHOWN_S:
            self._shown_s = time.monotonic()
            self._tell(shot)

    def _tell(self, shot: Shot | None) -> None:
        """Show the camera's frame, the hand's phase, and the median latencies."""
        phase = self._following.own.phase
        lines = [PAUSED if self._paused and phase != "calibrate" else ABOUT[phase]]
        lines += ["All motion is painted."] if self._following.recorder.rests else []
        lines += [quote_text(self._shots.ended)] if self._shots.ended else []
        times = [f"{name} {median(s):.2f} s" for name, s in self._latencies.items() if s]
        lines += [f"Median time from the camera's frame: {', '.join(times)}."] if times else []
        if (about := "  \n".join(lines)) != self._about.content:
            self._about.content = about
        if shot is not None:
            self._camera.image = marked(shot, self._tracker.joints_px)

    def _foresee(self) -> None:
        """Draw the objects where the poses so far move them."""
        then = time.monotonic()
        if self._following.recorder.live:
            foresight, time_s = self._following.foresee()
            self._page.show_objects(foresight)
            if np.isfinite(time_s):
                self._latencies["objects"].append(time.monotonic() - time_s)
        time.sleep(max(0.0, FORESEE_S - (time.monotonic() - then)))

    def _paint(self) -> None:
        """Make the next clip, once the hand moves."""
        following = self._following
        if not following.recorder.wait_for_motion(0.1):
            return

        def first() -> None:
            taken_s = following.recorder.taken_s
            if taken_s > self._painted_s:
                self._painted_s = taken_s
                self._latencies["painted"].append(time.monotonic() - taken_s)

        self._page.paint(
            following.recorder.take, first, lambda: following.committed(self._page.played)
        )


def marked(shot: Shot, joints_px: np.ndarray | None) -> np.ndarray:
    """Return a small frame of a camera with the bones of the hand."""
    scale = WIDTH / shot.frame.shape[1]
    small = cv2.resize(shot.frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if joints_px is not None:
        joints = np.round(joints_px * scale).astype(int).tolist()
        for first, last in SKELETONS["human"].bones:
            cv2.line(small, joints[first], joints[last], (255, 255, 255), 2, cv2.LINE_AA)
    return small
