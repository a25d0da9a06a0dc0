"""One hand in the frames of a camera, as they come.

A hand that was seen is searched in the region of its last keypoints, by one run of the landmark
network. Otherwise palms are searched in one tile of each frame in turn. The keypoints are lifted to
the camera's axes in meters of a hand of mean size, and smoothed by one euro filters (Casiez et al.
2012), which smooth less the faster the hand moves. Its depth, which is noisier, is smoothed more.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from egosim_jax.perception.video.estimates import RIGHT, HandTracks
from egosim_jax.perception.video.hands.detect import Candidates, find_joints
from egosim_jax.perception.video.hands.lift import PALM_BONES, lift
from egosim_jax.perception.video.hands.litert import HandNetworks
from egosim_jax.perception.video.hands.palms import cut_tile, decode_palms, make_tiles
from egosim_jax.perception.video.hands.regions import Regions, regions_of_joints, regions_of_palms
from egosim_jax.rendering.mesh import Side
from egosim_jax.types.arrays import RgbImage

MIN_PALM, MIN_PRESENCE = 0.5, 0.5
"""Minimum confidence of a palm, and of the landmark network in a hand."""
FOCAL = 0.9
"""Assumed focal length in units of the longer side of a frame: a view of 58 degrees."""
PALM_M = 0.085
"""Mean length of the palm's bones (`lift.PALM_BONES`) of a lifted hand, in meters."""


class OneEuro:
    """Low-pass filter of a point whose cutoff frequency grows with its speed."""

    def __init__(self, *, cutoff_hz: float, beta: float):
        self._cutoff_hz, self._beta = cutoff_hz, beta
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._value: np.ndarray | None = None
        self._speed, self._time_s = 0.0, 0.0

    def __call__(self, value: np.ndarray, time_s: float) -> np.ndarray:
        """Return the filtered value at a later time."""
        if self._value is not None:
            step_s = max(time_s - self._time_s, 1e-3)
            moved = np.linalg.norm(value - self._value, axis=-1).mean() / step_s
            self._speed += _share(1.0, step_s) * (moved - self._speed)
            share = _share(self._cutoff_hz + self._beta * self._speed, step_s)
            value = self._value + share * (value - self._value)
        self._value, self._time_s = value, time_s
        return value


def _share(cutoff_hz: float, step_s: float) -> float:
    """Return the weight of a new value in an exponential mean."""
    return 1 / (1 + 1 / (2 * np.pi * cutoff_hz * step_s))


class LiveHand:
    """Tracker of the wanted hand in consecutive frames of one size."""

    def __init__(self, networks: HandNetworks, side: Side):
        self._networks, self._right = networks, side == "right"
        self._tile = 0
        self.joints_px: Float[np.ndarray, "21 2"] | None = None
        """Keypoints in the last frame in pixels; None without a hand."""
        self._joints = OneEuro(cutoff_hz=2.5, beta=12.0)
        self._depth = OneEuro(cutoff_hz=1.0, beta=4.0)

    def see(self, frame: RgbImage, time_s: float) -> Float[np.ndarray, "21 3"] | None:
        """Return the hand's keypoints in the camera in meters, or None without a hand."""
        hand = self._follow(frame) or self._search(frame)
        if hand is None:
            self.joints_px = None
            return None
        if self.joints_px is None:
            self._joints.reset()
            self._depth.reset()
        self.joints_px = hand.joints_px[0]
        lifted = lifted_hand(hand.joints_px[0], hand.joints_hand_m[0], frame.shape[:2])
        return None if lifted is None else self._smooth(lifted, time_s)

    def _follow(self, frame: RgbImage) -> Candidates | None:
        """Return the hand in the region of its last keypoints."""
        if self.joints_px is None:
            return None
        return self._best(frame, regions_of_joints(self.joints_px[None]))

    def _search(self, frame: RgbImage) -> Candidates | None:
        """Return the hand of the most probable palm in the next tile."""
        tiles = make_tiles(*frame.shape[:2])
        tile, self._tile = tiles[self._tile % len(tiles)], self._tile + 1
        boxes, logits = self._networks.palms(cut_tile(frame, tile))
        palms = decode_palms(boxes[None], logits[None], [tile], min_score=MIN_PALM)
        if not len(palms.score):
            return None
        return self._best(frame, regions_of_palms(palms.boxes_px, palms.keypoints_px))

    def _best(self, frame: RgbImage, regions: Regions) -> Candidates | None:
        """Return the hand in some regions that is most probably there and of the wanted side."""
        numbers = np.zeros(len(regions.angle), int)
        hands = find_joints(frame[None], self._networks, numbers, regions, MIN_PRESENCE)
        if not len(hands):
            return None
        right = hands.right if self._right else 1 - hands.right
        return hands.take(np.array([int((hands.presence + right).argmax())]))

    def _smooth(self, joints_m: np.ndarray, time_s: float) -> Float[np.ndarray, "21 3"]:
        """Return filtered keypoints; only the depth of the complete hand is filtered twice."""
        depth = joints_m[:, 2].mean()
        smooth = np.exp(self._depth(np.log(depth)[None, None], time_s)[0, 0])
        return self._joints(joints_m * smooth / depth, time_s)


def lifted_hand(
    joints_px: Float[np.ndarray, "21 2"],
    joints_hand_m: Float[np.ndarray, "21 3"],
    size: tuple[int, int],
) -> Float[np.ndarray, "21 3"] | None:
    """Return keypoints in the camera of a frame of height and width, in meters.

    The palm's bones have the length of a hand of mean size. None behind the camera.
    """
    height, width = size
    focal = FOCAL * max(height, width)
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    pixels, shape = np.full((1, 2, 21, 2), np.nan), np.full((1, 2, 21, 3), np.nan)
    pixels[0, RIGHT], shape[0, RIGHT] = joints_px, joints_hand_m
    tracks = HandTracks(joints_px=pixels, joints_hand_m=shape, presence=np.eye(2)[[RIGHT]])
    joints_m = lift(tracks, intrinsics)[0, RIGHT]
    if not np.isfinite(joints_m).all():
        return None
    return joints_m * PALM_M / palm_length(joints_m)


def palm_length(joints_m: Float[np.ndarray, "21 3"]) -> float:
    """Return the mean length of the palm's bones."""
    start, end = joints_m[PALM_BONES].transpose(1, 0, 2)
    return float(np.linalg.norm(end - start, axis=-1).mean())
